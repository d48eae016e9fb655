"""Halts of robots whose own verbs run: their verdict waits for the verbs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import cast

from strands_robots.safety.gate import MotionGate
from strands_robots.safety.kept_gates import kept_gate
from strands_robots.safety.stopping import ForeignAnswer, PendingVerdict, StopVerdict, read_verdict
from strands_robots.safety.verbs_under_way import VerbCall, VerbsUnderWay


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


def under_way_of(target: object) -> VerbsUnderWay | None:
    """Return the own verbs of what is stopped; None where it has no gate of ours.

    No code of the robot's own is run: it may hang, and a stop follows.
    """
    # By its type: isinstance may ask a robot for its __class__.
    robot = cast(StopOfRobot, target).stopped_robot() if issubclass(type(target), StopOfRobot) else target
    try:
        gate = object.__getattribute__(robot, "__dict__").get("gate")
    except AttributeError:
        gate = None
    known = cast(MotionGate, gate) if issubclass(type(gate), MotionGate) else kept_gate(robot)
    return None if known is None else known.under_way


def void_calls(target: object) -> tuple[VerbCall, ...]:
    """Void the permits of the own verbs that run on ``target``; return their calls."""
    under_way = under_way_of(target)
    calls = under_way.calls if under_way else ()
    for each in calls:
        each.void()
    return calls


class _Here(threading.local):
    """Halts under way on this thread, the outermost first."""

    def __init__(self) -> None:
        self.halts: list[HaltedVerbs] = []


_here = _Here()


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
        _here.halts.append(self)

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
    if len(_here.halts) != 1:
        return lambda: False
    halted = _here.halts[0]
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
