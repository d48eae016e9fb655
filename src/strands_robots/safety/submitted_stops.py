"""Submitted stops of one target, which wait for its halt or its reading."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass, field, replace

from strands_robots.safety.stop_targets import Target, is_direct
from strands_robots.safety.stopping import ForeignAnswer, PendingVerdict, StopVerdict, graded
from strands_robots.safety.verbs_under_way import VerbCall
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

WAITING_MAX = 4096
"""Stops of one target that wait for its next halt. Beyond it the oldest is answered by its deadline alone."""

Answered = Callable[[StopVerdict], None]


@dataclass(eq=False, slots=True)
class SubmittedStop:
    """One submitted stop. Times are monotonic seconds.

    Attributes:
        within: seconds to halt, which count from ``since``.
        answered: called with a verdict that comes too late for the future.
        verbs: own verbs of the target that ran when it was submitted.
        asker: the thread that submitted it.
        pending: what is still to be read for the verdict; None until the halt has returned.
        begun: the moment at which its halt, or later its reading, began.
    """

    slot: TargetSlot | None
    target: Target | None
    name: str
    reason: str
    within: float
    since: float
    answered: Answered | None
    direct: bool = False
    verbs: tuple[VerbCall, ...] = ()
    asker: int = field(default_factory=threading.get_ident)
    extended: bool = False
    pending: PendingVerdict | None = None
    begun: float | None = None
    submitted: float = field(default_factory=time.monotonic)
    future: Future[StopVerdict] = field(default_factory=Future)
    answering: threading.Lock = field(default_factory=threading.Lock)

    def moment(self, part: float) -> float:
        """Return the moment at which ``part`` of the time to halt has passed."""
        return self.since + part * self.within

    def halted(self, answer: object) -> bool:
        """Take the answer of the halt; False where the verdict has still to be read."""
        if isinstance(answer, StopVerdict):
            self.resolve(answer)
            return True
        self.begun = None
        self.pending = answer if isinstance(answer, PendingVerdict) else ForeignAnswer(answer, self.name)
        return False

    def resolve(self, verdict: StopVerdict) -> None:
        """Hand out the verdict, marked if it is late."""
        late = self.answered
        # Watched until the deadline, an answered stop must not keep its robot alive.
        self.slot = self.target = self.answered = self.pending = None
        if not self._set(verdict) and late is not None:
            try:
                late(verdict)
            except Exception:
                logger.exception("A late verdict on %s was not taken.", self.name)

    def pending_stops(self) -> PendingStops | None:
        """Return where it waits or is carried out; None once it is resolved."""
        slot = self.slot
        if slot is None:
            return None
        return slot.halts if self.pending is None else slot.readings

    def extend(self) -> float | None:
        """Return the later deadline of a stop that waited behind another one.

        None where it has had it, or did not wait.
        """
        line = self.pending_stops()
        running = None if line is None else line.running
        if self.direct or self.extended or not running or self.future.done():
            return None
        self.extended = True
        if self.begun is not None:
            return self.begun + self.within
        return None if any(each.future.done() for each in running) else self.moment(2.0)

    def expire(self) -> bool:
        """Answer for the target that did not; False where it has answered."""
        target, pending = self.target, self.pending
        if target is None or self.future.done():
            return False
        why = f"no answer in {self.within:g} s"
        verdict = StopVerdict(not_stopped={self.name: why})
        try:
            if pending is not None:
                verdict = pending.unread(why)
            elif is_direct(target):
                verdict = graded(target.unanswered(why), self.name)
        except Exception:
            logger.exception("%s could not say what it does while its halt blocks.", self.name)
        return self._set(verdict)

    def _set(self, verdict: StopVerdict) -> bool:
        elapsed_ms = (time.monotonic() - self.submitted) * 1000
        # The callbacks of the first answer have returned before a late one is handed out.
        with self.answering:
            try:
                self.future.set_result(replace(verdict, elapsed_ms=elapsed_ms))
            except InvalidStateError:
                return False
            return True


class PendingStops:
    """Stops of one target that wait for the same work, and those that are worked on.

    One thread works at a time. One that blocks beyond a deadline is given up, and the next goes on with what waits.
    """

    def __init__(self) -> None:
        self.waiting: deque[SubmittedStop] = deque(maxlen=WAITING_MAX)
        self.running: list[SubmittedStop] | None = None
        self.stuck = 0
        self._changing = threading.Lock()

    def next(self, done: list[SubmittedStop] | None = None) -> list[SubmittedStop] | None:
        """Take all that wait, or None.

        Args:
            done: what the calling thread took before.
        """
        with self._changing:
            running = self.running
            if done is None and running is not None:
                return None
            if running is not done:
                # It was given up as stuck and is back; what could have no further thread goes on with it.
                self.stuck -= 1
                if running is not None:
                    if not _overdue(running):
                        return None
                    self.stuck += 1
            taken = []
            while self.waiting:
                taken.append(self.waiting.popleft())
                taken[-1].begun = time.monotonic()
            self.running = taken or None
            return self.running

    def more(self, running: list[SubmittedStop]) -> list[SubmittedStop] | None:
        """Add what has come meanwhile to ``running``; None if that was given up."""
        with self._changing:
            if self.running is not running:
                return None
            taken = []
            while self.waiting:
                taken.append(self.waiting.popleft())
                taken[-1].begun = time.monotonic()
            running.extend(taken)
            return taken

    def give_up(self, stuck: list[SubmittedStop]) -> bool:
        """Abandon the thread that works on ``stuck``; False if it has returned."""
        with self._changing:
            if self.running is not stuck:
                return False
            self.running = None
            self.stuck += 1
            return True


class TargetSlot:
    """Stops of one target, and the queue of the thread that is woken for them.

    It does not refer to the target; only its stops do.
    """

    def __init__(self, name: str, wake: queue.SimpleQueue[TargetSlot | None]) -> None:
        self.name = name
        self.wake = wake
        self.halts, self.readings = PendingStops(), PendingStops()
        self.owners = 0
        self.thread: threading.Thread | None = None


def _overdue(running: list[SubmittedStop]) -> bool:
    return any(each.future.done() for each in running)
