"""Velocity of a base: its writer, zeros after a stop, and its odometry."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.ros.link import (
    ConfirmingLink,
    EarlierRefusedError,
    Message,
    NoReceiptError,
    RosError,
    RosLink,
    Unwatch,
    UrgentLink,
)
from strands_robots.safety.gate import MotionsHeldError, Permit, PermitVoidError
from strands_robots.stop_log import stop_logger
from strands_robots.utils import MissingExtraError, plain_value

logger = stop_logger(__name__)

BLIND_HOLD_S = 5.0
"""Seconds of zeros, accepted without a failure, for a base whose odometry is silent."""

RECEIPT_S = 0.5
"""Seconds within which a server confirms a zero that went behind the commands; without, the base did not stop."""

CLOGGED_S = 0.1
"""Seconds after which a connection that does not accept a zero is cut, with the commands that it still holds."""


class VelocityPublisher:
    """Writer of commands under a permit, and of zeros without one."""

    def __init__(self, link: RosLink, topic: str, kind: str, zero: Mapping[str, Any]) -> None:
        self.link = link
        self.topic = topic
        self.kind = kind
        self._zero = dict(zero)
        self._lock = threading.Lock()
        self._urgent = link if isinstance(link, UrgentLink) else None
        self._queued_zero = _BackgroundZero(self.zero)
        self._clogged = False

    def send(self, fields: Mapping[str, Any], permit: Permit) -> None:
        """Send one command.

        Raises:
            PermitVoidError: a stop came first.
            MotionsHeldError: motions hold; nothing was sent.
        """
        with self._lock:
            if not permit.valid:
                raise PermitVoidError("the drive was stopped")
            if permit.held:
                raise MotionsHeldError("the drive holds")
            if self._urgent is not None:
                try:
                    self._urgent.prepare_urgent(self.topic, self.kind)
                except RosError as exc:
                    logger.warning("A stop of %s has one connection only: %s", self.topic, exc)
            self.link.publish(self.topic, self.kind, fields)

    def zero(self) -> None:
        """Send one zero after the write that may be in flight."""
        with self._lock:
            try:
                self.link.publish(self.topic, self.kind, self._zero)
            except EarlierRefusedError:
                # The error of an earlier command is still reported, but must not cost the base its zero.
                self.link.publish(self.topic, self.kind, self._zero)
                raise

    def urgent_zero(self) -> None:
        """Send one zero that nothing delays, and one after the commands.

        Where the link has a second connection, the first zero goes there and the other one is not waited for. A first
        connection that does not accept its zero in time is cut, so that no command in it arrives after the zeros.
        """
        if self._urgent is None:
            self.zero()
            return
        clogged = self._queued_zero.start() > CLOGGED_S
        if clogged:
            if not self._clogged:
                logger.warning("%s does not accept zeros after its commands; its connection is cut.", self.topic)
            self._urgent.cut()
        self._clogged = clogged
        try:
            self._urgent.publish_urgent(self.topic, self.kind, self._zero)
        except NoReceiptError:
            raise
        except RuntimeError:
            # A RosError; or there is no second connection, and no thread to make it.
            self._queued_zero.wait(CLOGGED_S)
            if isinstance(self.link, ConfirmingLink):
                self.link.confirm(RECEIPT_S)


class _BackgroundZero:
    """One zero at a time after the commands, sent on a thread.

    Args:
        zero: sends it; may block for as long as the connection is clogged.
    """

    def __init__(self, zero: Callable[[], None]) -> None:
        self._zero = zero
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._began = 0.0
        self._problem = ""

    def start(self) -> float:
        """Start sending a zero; return for how many seconds one is being sent.

        Without a thread to be had nothing is sent; :meth:`wait` then sends the zero.
        """
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                return time.monotonic() - self._began
            self._began = time.monotonic()
            self._problem = ""
            self._thread = None
            thread = threading.Thread(target=self._run, name="zero-in-background", daemon=True)
            with contextlib.suppress(RuntimeError):  # the second connection is still there, and needs no thread
                thread.start()
                self._thread = thread
            return 0.0

    def wait(self, within_s: float) -> None:
        """Wait until the zero is sent, or send it; :class:`RosError` where it was not."""
        thread = self._thread
        if thread is None:
            self._run()
        else:
            thread.join(within_s)
            if thread.is_alive():
                raise RosError(f"the connection has not taken a zero within {within_s:g} s")
        if self._problem:
            raise RosError(self._problem)

    def _run(self) -> None:
        try:
            self._zero()
        except Exception as exc:  # noqa: BLE001 - whatever the link raises is reported by wait
            self._problem = str(exc) or type(exc).__name__


class ZeroVelocityHold:
    """Zeros at the base's publish rate, the first at once, until it is still.

    ``still`` answers True, False or, where odometry is silent, None, and returns at once. None ends the hold after
    :data:`BLIND_HOLD_S`, counted from the first zero that was accepted, the last one that was not, or the last
    sample of odometry, whichever was latest. A hold whose zeros fail goes on until they are accepted, because the
    link may come back to a base that still moves; :meth:`cancel` ends every hold. ``ended`` is called on its thread.
    """

    def __init__(
        self,
        publisher: VelocityPublisher,
        rate_hz: float,
        still: Callable[[], bool | None],
        name: str,
        ended: Callable[[ZeroVelocityHold], None],
    ) -> None:
        self._publisher = publisher
        self._ended = ended
        # However low the publish rate, a zero goes out at least once a second.
        self._period_s = min(1.0, 1 / rate_hz)
        self._still = still
        self._cancelled = threading.Event()
        self.sent = threading.Event()
        self.problem = ""
        self._thread = threading.Thread(target=self._run, name=f"hold-{name}", daemon=True)
        try:
            self._thread.start()
        except RuntimeError as exc:
            logger.warning("%s gets a single zero: %s", publisher.topic, exc)
            self.problem = self._send()

    @property
    def running(self) -> bool:
        """True while zeros go out."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Send no more zeros: a new motion was allowed."""
        self._cancelled.set()

    def join(self, within_s: float) -> None:
        """Wait for the thread's end."""
        if self._thread.ident is not None:
            self._thread.join(within_s)

    def _run(self) -> None:
        try:
            self._send_zeros()
        finally:
            self._ended(self)

    def _send_zeros(self) -> None:
        blind_since: float | None = None
        while True:
            problem = self.problem = self._send()
            still = self._still() if self.sent.is_set() else None
            now = time.monotonic()
            if problem:
                blind_since = None
            elif still:
                return
            elif blind_since is None or still is not None:
                blind_since = now
            elif now - blind_since >= BLIND_HOLD_S:
                return
            if self._cancelled.wait(self._period_s):
                return

    def _send(self) -> str:
        """Send one zero; return why it was not accepted, or ""."""
        try:
            self._publisher.urgent_zero()
        except Exception as exc:  # noqa: BLE001 - whatever the link raises, the next zero is tried and the verdict says so
            problem = str(exc) or type(exc).__name__
            if problem != self.problem:
                logger.warning("A zero on %s failed: %s", self._publisher.topic, problem)
            return problem
        self.sent.set()
        return ""


class CurrentHold:
    """The one hold of a base, begun by every stop and ended by the next motion.

    Args:
        start: starts a hold, which calls what it is given at its end.
        idle: called when a hold has ended and no other one took its place.
    """

    def __init__(
        self,
        start: Callable[[Callable[[ZeroVelocityHold], None]], ZeroVelocityHold],
        idle: Callable[[], None] = lambda: None,
    ) -> None:
        self._start_one = start
        self._idle = idle
        self._lock = threading.Lock()
        self._current: ZeroVelocityHold | None = None
        self._ended_for: Permit | None = None

    def _on_end(self, hold: ZeroVelocityHold) -> None:
        with self._lock:
            idle = self._current in (hold, None)
        if idle:
            self._idle()

    @property
    def running(self) -> bool:
        """True while zeros go out."""
        current = self._current
        return current is not None and current.running

    def begin(self) -> ZeroVelocityHold:
        """Begin a fresh hold, whose first zero goes out at once."""
        with self._lock:
            if self._current is not None:
                self._current.cancel()
            self._current = self._start_one(self._on_end)
            return self._current

    def end_for(self, permit: Permit) -> None:
        """End the hold for a motion, unless a newer stop has voided the motion's permit."""
        with self._lock:
            self._ended_for = None
            if permit.valid and self._current is not None:
                self._ended_for = permit if self._current.running else None
                self._current.cancel()
                self._current = None

    def resume(self) -> None:
        """Begin again the hold that was ended for a motion which did not begin."""
        with self._lock:
            if self._ended_for is not None and self._ended_for.valid and self._current is None:
                self._current = self._start_one(self._on_end)

    def close(self, within_s: float = 1.0) -> None:
        """End the hold and wait for its thread."""
        with self._lock:
            current, self._current = self._current, None
        if current is not None:
            current.cancel()
            current.join(within_s)


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
    values = [v for v in map(plain_value, parts) if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(values) != len(parts):
        return None
    norm = math.hypot(*values)
    return norm if math.isfinite(norm) else None
