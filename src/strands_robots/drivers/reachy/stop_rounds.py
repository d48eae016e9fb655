"""Stops of moves that only the daemon can end: sent at once, within bounds.

A daemon may hang, so its answer is waited for on a thread of the round, never on that of the halt. A second stop is
sent beside the first one, which may wait for ever.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Generic, TypeVar

from strands_robots.stop_log import stop_logger
from strands_robots.threads import ReadyThreads

logger = stop_logger(__name__)

ROUNDS_MAX = 8
"""Rounds that may wait for the daemon at once. A further stop waits for the first that returns."""

SAME_STOP_S = 0.02
"""Seconds in which a second order is taken for the same stop: the plane and the executor both order a halt."""

T = TypeVar("T")
Work = Callable[[T, float], object]
"""Sends the stop that its first argument describes; returns by its second, in monotonic s, unless the daemon hangs."""


@dataclass(eq=False)
class StopRound(Generic[T]):
    """One stop on its way to the daemon."""

    about: T
    within: float
    ordered: float = field(default_factory=time.monotonic)
    answer: Future[object] = field(default_factory=Future)

    @property
    def deadline(self) -> float:
        """Moment of ``time.monotonic`` by which the daemon must have answered."""
        return self.ordered + self.within

    def wait(self) -> object:
        """Return the answer.

        Raises:
            TimeoutError: none came by the deadline.
            Exception: whatever the work raised.
        """
        try:
            return self.answer.result(max(0.0, self.deadline - time.monotonic()))
        except TimeoutError as exc:
            raise TimeoutError(f"the daemon has not answered within {self.within:.2g} s") from exc

    def carry_out(self, work: Work[T]) -> None:
        """Do the work on this thread."""
        try:
            answer = work(self.about, self.deadline)
        except BaseException as exc:  # noqa: BLE001 - whatever a stop raises is graded by who waits for it
            self.answer.set_exception(exc)
        else:
            self.answer.set_result(answer)


def _senders() -> ReadyThreads[Callable[[], None]]:
    return ReadyThreads("stop-sender", 1, lambda carry_out: carry_out(), threading.Thread.start, _replace)


def _replace() -> None:
    """Start the successor of the thread that took a round, on that thread."""
    try:
        _OfProcess.senders.refill()
    except RuntimeError as exc:
        logger.critical("No thread can be started for the next stop, which waits for this one: %s.", exc)


class _OfProcess:
    senders = _senders()

    @classmethod
    def renew(cls) -> None:
        """Start anew in a forked child, which has none of its parent's threads."""
        cls.senders = _senders()


os.register_at_fork(after_in_child=_OfProcess.renew)


def prepare() -> None:
    """Have a thread ready for the next stop. Raises RuntimeError where there is none."""
    if not _OfProcess.senders.wanted:
        _OfProcess.senders.prepare()


class StopRounds(Generic[T]):
    """Rounds of one kind for one robot; thread-safe.

    Args:
        work: carries a round out, on a thread of its own.
    """

    def __init__(self, work: Work[T]) -> None:
        self._work = work
        self._changing = threading.Lock()
        self._running = 0
        self._next: StopRound[T] | None = None
        self._unclaimed: StopRound[T] | None = None

    def order(self, about: T, within: float) -> None:
        """Send a stop at once, for the next :meth:`claim`. Does not wait for the daemon."""
        self._ordered(about, within)

    def claim(self, about: T, within: float) -> StopRound[T]:
        """Return the last round, if it goes on and is about the same, else a new one."""
        with self._changing:
            latest, self._unclaimed = self._unclaimed, None
        if latest is not None and not latest.answer.done() and (about is None or latest.about is about):
            return latest
        latest = self._ordered(about, within)
        with self._changing:
            self._unclaimed = None
        return latest

    def _ordered(self, about: T, within: float) -> StopRound[T]:
        fresh = StopRound(about, within)
        with self._changing:
            latest = self._unclaimed
            same = latest is not None and not latest.answer.done() and about in (None, latest.about)
            if latest is not None and same and fresh.ordered - latest.ordered < SAME_STOP_S:
                return latest
            if self._running >= ROUNDS_MAX:
                # It begins after all that share it, so its time is counted from the last of them.
                self._unclaimed = self._next = self._next or fresh
                self._next.about, self._next.ordered = about, fresh.ordered
                return self._next
            self._unclaimed = fresh
            self._running += 1
        try:
            prepare()
            _OfProcess.senders.items.put(partial(self._run, fresh))
        except RuntimeError as exc:
            logger.critical("No thread can be started to stop the daemon's moves; this one does it: %s.", exc)
            self._run(fresh)
        return fresh

    def _run(self, stop: StopRound[T] | None) -> None:
        while stop is not None:
            stop.carry_out(self._work)
            with self._changing:
                stop, self._next = self._next, None
                self._running -= stop is None
