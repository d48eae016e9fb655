"""Watch of control leases: it ends each one when its time is over.

The watch thread keeps the time and nothing else. Each lease ends on a thread of the pool, which stands ready for it, so
that neither the robot of another lease nor its observer is waited for.
"""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import Protocol

from strands_robots.safety.process import undisturbed
from strands_robots.serving.workers import UNBOUNDED
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

AHEAD_S = 0.25
"""Time before the end of a lease in which its robot is read: one at rest by its own word is not halted."""


class TimedLease(Protocol):
    """A lease that ends by itself."""

    @property
    def due(self) -> float | None:
        """The monotonic moment at which it is over; None where there is none."""

    def expire(self, ahead: float) -> None:
        """End it in its time; return at once where that is more than ``ahead`` s away."""


class LeaseWatch:
    """One thread that ends leases in time; it lives as long as there is one."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._leases: set[TimedLease] = set()
        self._thread: threading.Thread | None = None

    @property
    def running(self) -> bool:
        """True while there is a lease to end."""
        return self._thread is not None

    def add(self, lease: TimedLease) -> None:
        """Watch a lease until it is over.

        Raises:
            RuntimeError: no thread can be started.
        """
        with self._changed:
            self._leases.add(lease)
            if self._thread is None:
                thread = threading.Thread(target=self._work, name="control-leases", daemon=True)
                thread.start()
                self._thread = thread
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                due = {each: at for each in self._leases if (at := each.due) is not None}
                now = time.monotonic()
                ending = [each for each, at in due.items() if at - AHEAD_S <= now]
                self._leases = set(due).difference(ending)
                if not due:
                    self._thread = None
                    return
                if not ending:
                    self._changed.wait(min(due.values()) - AHEAD_S - now)
            for each in ending:
                UNBOUNDED.submit(partial(self._end, each))

    def _end(self, lease: TimedLease) -> None:
        # A whole collection at this moment would hold the halts back.
        calm = undisturbed(many=False)
        try:
            lease.expire(AHEAD_S)
        except Exception:
            logger.critical("What the holder of a lease moved was not halted at its end.", exc_info=True)
        finally:
            calm()
            # It may have been renewed meanwhile.
            if lease.due is not None:
                self.add(lease)
