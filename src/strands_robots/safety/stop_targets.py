"""Targets of a stop: robots, their own verbs, and the stops that wait for them."""

from __future__ import annotations

import functools
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable
from concurrent.futures import Future, InvalidStateError
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol, cast, runtime_checkable

from strands_robots.safety.gate import MotionGate, OrderedStop, VerbCall, VerbsUnderWay, kept_gate
from strands_robots.safety.stopping import ForeignAnswer, PendingVerdict, StopVerdict, graded, read_verdict
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)


@runtime_checkable
class Haltable(Protocol):
    """A robot with the one verb that halts every motion source and returns a verdict."""

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop everything that moves this robot; returns within the halt deadline."""


class Stoppable(Haltable, Protocol):
    """A robot that the plane can stop: one with a gate and a halt."""

    gate: MotionGate


class RobotWrapper:
    """Robot that stands for another one: their stops are stops of one target."""

    wrapped: Any


def body_of(robot: Any) -> Any:
    """Return the robot that a wrapper stands for, else ``robot`` itself."""
    # By its type: isinstance may ask a robot for its __class__.
    return robot.wrapped if issubclass(type(robot), RobotWrapper) else robot


def holds_several(target: object) -> bool:
    """Return whether its class lists several robots, which its halt stops together."""
    return hasattr(type(target), "list_robots")


@runtime_checkable
class NotesMotion(Protocol):
    """Target that notes its motions before its permits are void."""

    def halt_ordered(self) -> None:
        """Note what moves. Must not block."""


@runtime_checkable
class HaltsInParts(Protocol):
    """Target whose verdict may have to be read after its halt.

    Its public ``halt`` is marked by :func:`~strands_robots.safety.stopping.halts_in_parts`.
    """

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Halt on this thread by ``deadline`` (monotonic s), unless the device blocks."""


@runtime_checkable
class DirectTarget(NotesMotion, HaltsInParts, Protocol):
    """Target that says itself what is known while its :meth:`halt_here` blocks.

    No second thread is started for it meanwhile: whatever blocks the first, such as its bus, would block the second.
    """

    def unanswered(self, why: str) -> StopVerdict:
        """Return the verdict while :meth:`halt_here` has not returned. Must not block."""


Target = Haltable | HaltsInParts


def note_motion(target: object) -> None:
    """Let a target note what moves, before its permits are void.

    Never raises: a stop follows.
    """
    # Of its class: an attribute of the robot's own may be looked up anywhere. A check of a protocol costs more than
    # a stop may.
    note = getattr(type(target), "halt_ordered", None)
    if note is not None:
        try:
            note(target)
        except Exception:
            logger.exception("A robot could not note what moves before its stop.")


def revoke_permits(target: object) -> None:
    """Void the permits of a target that has a gate of ours.

    Never raises: a stop follows.
    """
    try:
        # Without its ``__getattr__``, which may look names up anywhere.
        gate = object.__getattribute__(target, "gate")
    except AttributeError:
        return
    except Exception:
        logger.exception("The gate of a robot could not be read before its stop.")
        return
    if isinstance(gate, MotionGate):
        gate.revoke()


@functools.lru_cache(maxsize=256)
def has_parts(kind: type) -> bool:
    """Return whether the executor calls the parts of the halt of such a target."""
    halt = getattr(kind, "halt", None)
    return hasattr(kind, "halt_here") and (halt is None or getattr(halt, "halts_in_parts", False))


def target_key(target: Target) -> Hashable:
    """Return an identity that is equal for the same target."""
    body = target.wrapped if issubclass(type(target), RobotWrapper) else target  # type: ignore[union-attr]
    params = getattr(type(body), "__dataclass_params__", None)
    if params is None or not (params.frozen and params.eq):
        return id(body)
    # By the identity of its parts, which may be robots without a hash, and by the value of a name.
    parts = (getattr(body, each.name) for each in fields(cast(Any, body)))
    return (type(body), *(part if isinstance(part, str) else id(part) for part in parts))


class VerbsAfterHalt(PendingVerdict):
    """Verdict of a halt, with the own verbs that ran when it came.

    Args:
        answer: of the halt, which has returned.
        calls: ran before the halt; their permits are void.
        until: monotonic s at which a verb that has not returned did not stop.
    """

    def __init__(self, answer: StopVerdict | PendingVerdict, calls: tuple[VerbCall, ...], until: float) -> None:
        rest = answer if isinstance(answer, PendingVerdict) else None
        super().__init__(until)
        self._rest, self._calls = rest, calls
        self._verdict = answer if isinstance(answer, StopVerdict) else None

    def known(self) -> StopVerdict | None:
        if self._rest is not None and self._verdict is None:
            self._verdict = self._rest.known()
        return None if self._verdict is None or self._running() else self._with_verbs(self._verdict)

    def read(self) -> object:
        # One reading serves all stops of a robot, also one whose own verdict still waits for it.
        return None if self._rest is None else self._rest.read()

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        if self._rest is not None and self._verdict is None:
            last_of_rest = last or time.monotonic() >= self._rest.until
            self._verdict = self._rest.judged(reading, last=last_of_rest)
        if self._verdict is None or (self._running() and not last):
            return None
        return self._with_verbs(self._verdict)

    def unread(self, why: str) -> StopVerdict:
        if self._verdict is not None:
            return self._with_verbs(self._verdict)
        return self._with_verbs(StopVerdict() if self._rest is None else self._rest.unread(why))

    def _running(self) -> bool:
        return any(not each.ended for each in self._calls)

    def _with_verbs(self, verdict: StopVerdict) -> StopVerdict:
        names = {each.name: True for each in self._calls}
        names |= {each.name: False for each in self._calls if not each.ended}
        returned = [name for name, ended in names.items() if ended and name not in verdict.halted]
        why = "it has not returned, and may go on to move the robot"
        unreturned = {name: why for name, ended in names.items() if not ended}
        return replace(verdict, halted=(*verdict.halted, *returned), not_stopped={**verdict.not_stopped, **unreturned})


class StopOfRobot:
    """A stop that is no robot itself: of a part of one, or with more than a halt."""

    def stopped_robot(self) -> object:
        """Return the robot whose own verbs it stops. Must not block."""
        raise NotImplementedError


def known_gate(target: object) -> MotionGate | None:
    """Return the gate of what is stopped; None where it has none of ours.

    No code of the robot's own is run: it may hang, and a stop follows.
    """
    # By its type: isinstance may ask a robot for its __class__.
    robot = cast(StopOfRobot, target).stopped_robot() if issubclass(type(target), StopOfRobot) else target
    try:
        gate = object.__getattribute__(robot, "__dict__").get("gate")
    except AttributeError:
        gate = None
    return cast(MotionGate, gate) if issubclass(type(gate), MotionGate) else kept_gate(robot)


def under_way_of(target: object) -> VerbsUnderWay | None:
    """Return the own verbs of what is stopped; None where it has no gate of ours."""
    known = known_gate(target)
    return None if known is None else known.under_way


def void_calls(target: object, stop: OrderedStop | None = None) -> tuple[VerbCall, ...]:
    """Void the permits of the own verbs that run on ``target``; return their calls.

    Args:
        stop: which the gate keeps as its newest; None for one that is noted already.
    """
    known = known_gate(target)
    if known is not None and stop is not None:
        known.newest_stop = stop
    calls = () if known is None else known.under_way.calls
    for each in calls:
        each.void()
    return calls


_here = threading.local()
"""Its ``halts`` are the halts under way on this thread, the outermost first."""


class HaltedVerbs:
    """The own verbs of a target that is about to be halted on this thread.

    A halt inside that waits for verbs itself leaves that to this one.

    Args:
        target: of the halt; permits of its verbs are void from now on.
        before: calls that ran when the halt was asked for.
        asked_by: threads that asked for the halt; a verb that halts its own robot is not waited for.
    """

    def __init__(self, target: object, before: Iterable[VerbCall] = (), asked_by: Collection[int] = ()) -> None:
        self._under_way = under_way_of(target)
        self._calls = dict.fromkeys((*before, *void_calls(target)))
        # Several stops have one answer, and whoever does not run the verb has to be told of it.
        self._itself = next(iter(asked_by)) if len(set(asked_by)) == 1 else None
        _here.__dict__.setdefault("halts", []).append(self)

    def asked(self, call: VerbCall) -> bool:
        """Return True for a verb that asks for the halt itself."""
        return call.thread == self._itself

    def after(self, answer: object, name: str, until: float) -> object:
        """Return the answer to the halt, not settled while a verb has not returned.

        Args:
            answer: of the halt, or what it raised.
            name: what the verdict calls a target whose halt names nothing.
            until: monotonic s at which a verb that has not returned did not stop.
        """
        _here.halts.remove(self)
        if self._under_way:
            # One that began while the halt came saw a valid permit, which is void now.
            self._calls.update(dict.fromkeys(each for each in self._under_way.calls if not each.valid()))
        calls = tuple(each for each in self._calls if not self.asked(each))
        if not calls or _here.halts:
            return answer
        given = answer if isinstance(answer, StopVerdict | PendingVerdict) else ForeignAnswer(answer, name)
        return VerbsAfterHalt(given, calls, until)


def verbs_to_end(under_way: VerbsUnderWay) -> Callable[[], bool]:
    """Return whether verbs run that a halt under way on this thread has to wait for.

    An inner halt waits for none: the outermost does.
    """
    halts: list[HaltedVerbs] = getattr(_here, "halts", [])
    if len(halts) != 1:
        return lambda: False
    halted = halts[0]
    return lambda: any(not each.valid() and not halted.asked(each) for each in under_way.calls)


def halted_with_verbs(robot: object, halt: Callable[[], StopVerdict | PendingVerdict], deadline: float) -> StopVerdict:
    """Halt a robot on this thread; the verdict waits for its own verbs.

    Args:
        robot: whose verbs may run.
        halt: returns its answer.
        deadline: monotonic s at which a verb that has not returned did not stop.
    """
    verbs = HaltedVerbs(robot, asked_by=(threading.get_ident(),))
    answer: StopVerdict | PendingVerdict | None = None
    try:
        answer = halt()
    finally:
        given = verbs.after(answer, "", deadline)
    return read_verdict(given if isinstance(given, PendingVerdict) else answer)


WAITING_MAX = 4096
"""Stops of one target that wait for its next halt. Beyond it the oldest is answered by its deadline alone."""

Answered = Callable[[StopVerdict], None]


@dataclass(eq=False, slots=True)
class SubmittedStop:
    """One submitted stop. Times are monotonic seconds.

    Attributes:
        within: seconds to halt, which count from ``since``.
        answered: called with a verdict that comes too late for the future.
        parts: the executor calls the parts of its halt.
        direct: it answers for itself while its halt blocks.
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
    parts: bool = False
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
            elif self.direct:
                verdict = graded(cast(DirectTarget, target).unanswered(why), self.name)
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
