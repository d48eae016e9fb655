"""A base's own velocity topic: the one place that writes to it, and the zeros that hold it still."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.drivers.ros.behind import Behind
from strands_robots.ros.link import EarlierRefusedError, RosError, RosLink, UrgentLink
from strands_robots.safety.gate import Permit, PermitVoidError

logger = logging.getLogger(__name__)

BLIND_HOLD_S = 5.0
"""Seconds of zeros, taken without a failure, for a base whose odometry says nothing."""

CLOGGED_S = 0.1
"""Seconds after which a connection that does not take a zero is given up, with the commands that it still holds."""


class VelocityWire:
    """Writes commands under a permit, and zeros without one: a stop is never refused for lack of leave to move."""

    def __init__(self, link: RosLink, topic: str, kind: str, zero: Mapping[str, Any]) -> None:
        self.link = link
        self.topic = topic
        self.kind = kind
        self._zero = dict(zero)
        self._lock = threading.Lock()
        self._urgent = link if isinstance(link, UrgentLink) else None
        self._behind = Behind(self.zero)
        self._clogged = False

    def send(self, fields: Mapping[str, Any], permit: Permit) -> None:
        """One command. Raises :class:`PermitVoidError` when a stop came first, else what the link raises."""
        with self._lock:
            if not permit.valid:
                raise PermitVoidError("the drive was stopped")
            if self._urgent is not None:
                self._prepare(self._urgent)
            self.link.publish(self.topic, self.kind, fields)

    def zero(self) -> None:
        """One zero, behind the write that may be in flight. Raises what the link raises."""
        with self._lock:
            try:
                self.link.publish(self.topic, self.kind, self._zero)
            except EarlierRefusedError:
                # What was wrong with a command is told all the same, but it must not cost the base its zero.
                self.link.publish(self.topic, self.kind, self._zero)
                raise

    def halt(self) -> None:
        """One zero that nothing delays, and one behind the commands. Raises what the link raises.

        Where the link has a second way, the first goes there and the other is not waited for. A way that does not
        take the other in time is cut, so that no command in it comes after the zeros.
        """
        if self._urgent is None:
            self.zero()
            return
        clogged = self._behind.offer() > CLOGGED_S
        if clogged:
            if not self._clogged:
                logger.warning("%s does not take zeros behind its commands; its connection is cut.", self.topic)
            self._urgent.cut()
        self._clogged = clogged
        try:
            self._urgent.publish_urgent(self.topic, self.kind, self._zero)
        except RuntimeError:
            # A RosError; or the second way is not there, and no thread to make it.
            self._behind.confirm(CLOGGED_S)

    def _prepare(self, urgent: UrgentLink) -> None:
        try:
            urgent.prepare_urgent(self.topic, self.kind)
        except RosError as exc:
            logger.warning("A stop of %s has one way only: %s", self.topic, exc)


class Hold:
    """Zeros at the base's publish rate on a thread of their own, the first at once, until the base is still.

    ``still`` answers True, False or, where no odometry speaks, None, and returns at once. None ends the hold after
    :data:`BLIND_HOLD_S`, counted from the first zero that was taken, from the last one that was not and from the
    last word of odometry, whichever was latest. A hold whose zeros fail goes on until they are taken, because the link
    may come back to a base that still moves; :meth:`cancel` ends every hold.
    """

    def __init__(self, wire: VelocityWire, rate_hz: float, still: Callable[[], bool | None], name: str) -> None:
        self._wire = wire
        # However rarely a base is driven, its zeros come once a second at least.
        self._period_s = min(1.0, 1 / rate_hz)
        self._still = still
        self._cancelled = threading.Event()
        self.tried = threading.Event()
        self.sent = threading.Event()
        self.problem = ""
        self._thread = threading.Thread(target=self._run, name=f"hold-{name}", daemon=True)
        try:
            self._thread.start()
        except RuntimeError as exc:
            logger.warning("%s gets one zero alone: %s", wire.topic, exc)
            self.problem = self._send()
            self.tried.set()

    @property
    def running(self) -> bool:
        """Zeros still go out."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """No more zeros: a new motion was allowed."""
        self._cancelled.set()

    def join(self, within_s: float) -> None:
        """Wait for the thread's end."""
        if self._thread.ident is not None:
            self._thread.join(within_s)

    def _run(self) -> None:
        blind_since: float | None = None
        while True:
            problem = self._send()
            self.problem = problem
            self.tried.set()
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
        """One zero; why it was not taken, or ""."""
        try:
            self._wire.halt()
        except Exception as exc:  # noqa: BLE001 - whatever the link raises, the next zero is tried and the verdict says so
            problem = str(exc) or type(exc).__name__
            if problem != self.problem:
                logger.warning("A zero on %s failed: %s", self._wire.topic, problem)
            return problem
        self.sent.set()
        return ""


class Holds:
    """The one hold of a base: begun by every stop, ended by a motion that was allowed after it."""

    def __init__(self, start: Callable[[], Hold]) -> None:
        self._start = start
        self._lock = threading.Lock()
        self._current: Hold | None = None
        self._ended_for: Permit | None = None

    @property
    def running(self) -> bool:
        """Zeros still go out."""
        current = self._current
        return current is not None and current.running

    def begin(self) -> Hold:
        """A fresh hold, whose first zero goes out at once."""
        with self._lock:
            if self._current is not None:
                self._current.cancel()
            self._current = self._start()
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
        """Begin the hold again that the last motion has ended: it never began. A newer stop has begun its own."""
        with self._lock:
            if self._ended_for is not None and self._ended_for.valid and self._current is None:
                self._current = self._start()

    def close(self, within_s: float = 1.0) -> None:
        """End the hold and wait for its thread."""
        with self._lock:
            current, self._current = self._current, None
        if current is not None:
            current.cancel()
            current.join(within_s)
