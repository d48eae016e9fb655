"""Watch of control leases: it ends each one when its time is over.

The watch thread keeps the time and nothing else. A lease ends on a thread of the pool, so that neither the robot of
another lease nor its observer is waited for.
"""

from __future__ import annotations

import logging
import threading
import time
from functools import partial
from typing import Protocol

from strands_robots.serving.workers import UNBOUNDED

logger = logging.getLogger(__name__)

STATUS_S = 0.03
"""Longest wait at the end of a lease for the robot's own word that it is at rest."""


class TimedLease(Protocol):
    """A lease that ends by itself."""

    @property
    def due(self) -> float | None:
        """The monotonic moment at which it is over; None where there is none."""

    def expire(self, within: float) -> None:
        """End it if its time is over; its robot is read for ``within`` s at most."""


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
                over = [each for each, at in due.items() if at <= now]
                self._leases = set(due).difference(over)
                if not due:
                    self._thread = None
                    return
                if not over:
                    self._changed.wait(min(due.values()) - now)
            for each in over:
                UNBOUNDED.submit(partial(self._end, each))

    def _end(self, lease: TimedLease) -> None:
        try:
            lease.expire(STATUS_S)
        except Exception:
            logger.critical("What the holder of a lease moved was not halted at its end.", exc_info=True)
        finally:
            # It may have been renewed meanwhile.
            if lease.due is not None:
                self.add(lease)
