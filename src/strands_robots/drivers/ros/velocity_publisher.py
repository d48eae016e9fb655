"""Velocity topic of a base: its only writer, and the zeros after a stop."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.ros.link import (
    ConfirmingLink,
    EarlierRefusedError,
    NoReceiptError,
    RosError,
    RosLink,
    UrgentLink,
)
from strands_robots.safety.gate import MotionsHeldError, Permit, PermitVoidError
from strands_robots.stop_log import stop_logger

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

    def _start(self) -> ZeroVelocityHold:
        return self._start_one(self._on_end)

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
        """Begin again the hold that was ended for a motion which did not begin."""
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
