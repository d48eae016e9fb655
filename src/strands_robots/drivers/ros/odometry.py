"""Monitor of a base's odometry: whether the base is still."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from typing import Any

from strands_robots.ros.link import Message, RosError, RosLink, Unwatch
from strands_robots.stop_log import stop_logger
from strands_robots.utils import MissingExtraError

logger = stop_logger(__name__)

STILL_LINEAR = 0.01
"""m/s below which a base counts as still."""

STILL_ANGULAR = 0.02
"""rad/s below which a base counts as still."""

STILL_SAMPLES = 2
"""Samples in a row that must be below both, because a single one may be a reversal of direction."""

FRESH_S = 1.0
"""Seconds after which a sample is too old to count."""

RETRY_S = 0.5
"""Seconds between two attempts to watch a topic that could not be watched."""


def speeds(message: Message) -> tuple[float, float] | None:
    """Return the linear (m/s) and angular (rad/s) speed in a message, or None.

    The message is a ``nav_msgs/Odometry``, a ``TwistStamped`` or a ``turtlesim/Pose``.
    """
    if "linear_velocity" in message and "theta" in message:
        linear, angular = _norm(message["linear_velocity"]), _norm(message.get("angular_velocity"))
    else:
        twist: Any = message.get("twist")
        if isinstance(twist, Mapping) and isinstance(twist.get("twist"), Mapping):
            twist = twist["twist"]
        if not isinstance(twist, Mapping):
            return None
        linear, angular = _norm(twist.get("linear")), _norm(twist.get("angular"))
    return None if linear is None or angular is None else (linear, angular)


class OdometryMonitor:
    """Monitor of an odometry topic; without a topic its answers are None."""

    def __init__(self, link: RosLink, topic: str | None, kind: str | None) -> None:
        self._link = link
        self.topic = topic
        self._kind = kind
        self._lock = threading.Lock()
        self._unwatch: Unwatch | None = None
        self._starting = threading.Lock()
        self._sample_lock = threading.Lock()
        self._closings = 0
        self._tried_at = -math.inf
        self._problem = ""
        self._speeds: tuple[float, float] | None = None
        self._at = -math.inf
        self._still_in_a_row = 0

    @property
    def watched(self) -> bool:
        """True while the topic is watched, and where there is none."""
        return self.topic is None or self._unwatch is not None

    def start(self) -> None:
        """Watch from now on, or log why not; a second call does nothing."""
        self._start(self._closings)

    def start_in_background(self) -> None:
        """Start on a thread, because the topic's type may take seconds to find."""
        if self.watched or time.monotonic() - self._tried_at < RETRY_S or not self._starting.acquire(blocking=False):
            return
        closings = self._closings

        def run() -> None:
            try:
                self._start(closings)
            finally:
                self._starting.release()

        try:
            threading.Thread(target=run, name="odometry-start", daemon=True).start()
        except RuntimeError as exc:
            self._starting.release()
            logger.warning("%s is not watched: %s", self.topic, exc)

    def close(self) -> None:
        """Stop watching."""
        with self._lock:
            self._closings += 1
            unwatch, self._unwatch = self._unwatch, None
        if unwatch is not None:
            unwatch()

    def _start(self, closings: int) -> None:
        with self._lock:
            # A start from before a close must not open the link again after it.
            if self.topic is None or self._unwatch is not None or closings != self._closings:
                return
            problem = ""
            try:
                self._unwatch = self._link.watch(self.topic, self._kind, self._on_message)
            except (RosError, MissingExtraError) as exc:
                problem = str(exc)
            if problem and problem != self._problem:
                logger.warning("%s is not watched: %s", self.topic, problem)
            self._problem, self._tried_at = problem, time.monotonic()

    def expect_stillness(self) -> None:
        """Forget the samples so far: only later ones can show that the base is still."""
        with self._sample_lock:
            self._still_in_a_row = 0
            self._at = -math.inf

    @property
    def still(self) -> bool | None:
        """True: the base is still. False: it moves. None: there is no fresh sample."""
        with self._sample_lock:
            if time.monotonic() - self._at > FRESH_S or self._speeds is None:
                return None
            return self._still_in_a_row >= STILL_SAMPLES

    @property
    def last_speeds(self) -> tuple[float, float] | None:
        """Linear (m/s) and angular (rad/s) speed of the last usable sample."""
        return self._speeds

    def _on_message(self, message: Message) -> None:
        measured = speeds(message)
        if measured is None:
            return
        still = measured[0] <= STILL_LINEAR and measured[1] <= STILL_ANGULAR
        # Under the lock, because a stop may forget the samples at the same time.
        with self._sample_lock:
            self._still_in_a_row = self._still_in_a_row + 1 if still else 0
            self._speeds = measured
            self._at = time.monotonic()


def _norm(part: object) -> float | None:
    parts = list(part.values()) if isinstance(part, Mapping) else [part]
    values = [v for v in parts if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(values) != len(parts):
        return None
    norm = math.hypot(*values)
    return norm if math.isfinite(norm) else None
