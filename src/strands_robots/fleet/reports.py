"""Reports of a robot: its task, its joints, its events and its refusals."""

from __future__ import annotations

import math
import sys
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Protocol, Self, TypeGuard

from strands_robots.contract import AT_REST, RUNNING
from strands_robots.envelope import Envelope, RefusalReason, error, text_of
from strands_robots.errors import (
    ApprovalError,
    ArgumentsError,
    BusyError,
    CallerError,
    ControlError,
    LockoutError,
    NoAnswerError,
    NoSuchRobotError,
    RefusalError,
    RobotError,
    UnknownVerbError,
    UnreachableError,
)
from strands_robots.fleet.adapter import NetworkAdapter, RobotEvent
from strands_robots.utils import near, plain_text

TASK_MAX = 2000
"""Characters of a text of a task."""


def task_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a robot does, of a world its first task.

    It has ``state``, ``instruction``, and as far as they are reported ``step``, ``policy`` and ``who``, which is the
    robot of the world. The texts are plain, and a step is an integer.
    """
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        named = next(((name, row) for name, row in running.items() if isinstance(row, Mapping)), None)
        if named is None:
            return {"state": "idle"}
        name, row = named
        policy, instruction = _text(row.get("policy")), _text(row.get("instruction"))
        return {
            "state": "running",
            "instruction": instruction,
            "policy": policy,
            **_step(row.get("step")),
            "who": _text(name),
        }
    task = {"state": _text(facts.get("task_status")).lower() or "idle", "instruction": _text(facts.get("instruction"))}
    return task | _step(facts.get("step_count"))


def runs(facts: Mapping[str, Any], robot_name: str = "") -> bool:
    """Return whether a robot, or one of a world, runs a task by its status."""
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        return robot_name in running if robot_name else bool(running)
    return str(facts.get("task_status", "")).lower() in RUNNING


def outcome_of(facts: Mapping[str, Any], robot_name: str = "") -> dict[str, str]:
    """Return how the last task of a robot, or of one of a world, ended by its status.

    It has ``state`` and ``error``, and is empty where the status does not tell.
    """
    outcomes: object = facts.get("outcomes")
    if isinstance(outcomes, Mapping):
        rows = [outcomes.get(robot_name)] if robot_name else outcomes.values()
        facts = next((each for each in rows if isinstance(each, Mapping)), {})
    state = _text(facts.get("task_status")).lower()
    if state not in AT_REST or state == "idle":
        return {}
    return {"state": state, "error": _text(facts.get("error") or facts.get("why")) if state == "error" else ""}


def _text(value: object) -> str:
    return plain_text(value, TASK_MAX)


def _step(value: object) -> dict[str, int]:
    return {"step": value} if isinstance(value, int) and not isinstance(value, bool) else {}


Range = tuple[float, float]
"""Lower and upper limit of a joint, in the unit that the robot states."""

JOINTS_MAX = 64


def joint_limits(features: Mapping[str, Any]) -> dict[str, Range]:
    """Return the joint limits in an answer to getFeatures; a world's first robot."""
    chosen = _first(features)
    found: dict[str, Range] = {}
    for key in ("joints", "ranges"):
        joints = chosen.get(key)
        for name, limits in joints.items() if isinstance(joints, Mapping) else ():
            pair = [value for value in limits if is_finite(value)] if isinstance(limits, list | tuple) else []
            if len(pair) == 2 and pair[0] < pair[1]:
                # A real robot names the range of an action, such as pan.pos, and the position of the joint, pan.
                found[str(name)] = found[str(name).removesuffix(".pos")] = (float(pair[0]), float(pair[1]))
    return found


def joint_units(features: Mapping[str, Any]) -> dict[str, str]:
    """Return the unit of each joint in an answer to getFeatures.

    Of a world these are the first robot's.
    """
    units = _first(features).get("joint_units")
    named = list(units.items())[:JOINTS_MAX] if isinstance(units, Mapping) else []
    found = {str(name): str(unit)[:40] for name, unit in named}
    # A real robot names the unit of an action, such as pan.pos, and the position of the joint, pan.
    return {**{name.removesuffix(".pos"): unit for name, unit in found.items()}, **found}


def _first(features: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the features of a robot, of a world those of its first one."""
    robots = features.get("robots")
    chosen = next(iter(robots.values())) if isinstance(robots, Mapping) and robots else features
    return chosen if isinstance(chosen, Mapping) else {}


def is_finite(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a finite number, and no boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


EVENTS_MAX = 10_000
"""Events that wait for a slow reader; a further one displaces the oldest."""

BYTES_MAX = 64 * 1024 * 1024
"""Bytes of memory that waiting events may take; the oldest ones go first."""


class EventFeed:
    """Events of one robot as they come; an iterator and context manager."""

    def __init__(self, robot: str, network: NetworkAdapter, timeout: float | None) -> None:
        self._arrived: deque[tuple[RobotEvent, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._timeout = timeout
        self._end: Callable[[], None] | None = network.subscribe(robot, self._push)

    def close(self) -> None:
        """Receive no more events."""
        end, self._end = self._end, None
        if end is not None:
            end()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> RobotEvent:
        with self._changed:
            if self._changed.wait_for(lambda: self._arrived, self._timeout):
                return self._oldest()
        self.close()
        raise StopIteration

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def _push(self, event: RobotEvent) -> None:
        size = size_of(event.payload)
        with self._changed:
            self._arrived.append((event, size))
            self._bytes += size
            while len(self._arrived) > EVENTS_MAX or (self._bytes > BYTES_MAX and len(self._arrived) > 1):
                self._oldest()
            self._changed.notify()

    def _oldest(self) -> RobotEvent:
        event, size = self._arrived.popleft()
        self._bytes -= size
        return event


def size_of(value: object) -> int:
    """Return the bytes of memory that a decoded JSON value takes."""
    total, waiting = 0, [value]
    while waiting:
        each = waiting.pop()
        total += sys.getsizeof(each)
        if isinstance(each, Mapping):
            waiting += each.keys()
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each
    return total


WHY_MAX = 500

BY_REASON: Mapping[str, type[RefusalError]] = {
    RefusalReason.ARGUMENTS.value: ArgumentsError,
    RefusalReason.CALLER.value: CallerError,
    RefusalReason.CONTROL.value: ControlError,
    RefusalReason.LOCKOUT.value: LockoutError,
    RefusalReason.APPROVAL.value: ApprovalError,
    RefusalReason.BUSY.value: BusyError,
    RefusalReason.FAILED.value: RobotError,
}

LEASE_CODES = ("not_holder", "displaced", "lease_over")

EXACT: Mapping[str, tuple[type[RefusalError], str]] = {
    "command rejected": (LockoutError, "it is locked by an emergency stop"),
    "busy": (BusyError, "it has not yet answered earlier calls"),
    "dispatch error": (RobotError, "the verb failed inside the robot; its log has the details"),
    "replay rejected": (CallerError, "the message came twice or late; compare the clocks of both machines"),
}
"""Refusals of the mesh, with what they mean."""

WORDS: tuple[tuple[str, type[RefusalError]], ...] = (
    ("validation: action must be one of", UnknownVerbError),
    ("validation: ", ArgumentsError),
    ("is locked by", LockoutError),
    ("holds control", ControlError),
    ("has taken control", ControlError),
    ("this lease is over", ControlError),
    ("needs operator approval", ApprovalError),
    ("cannot be attributed", ApprovalError),
    ("may not move this robot", CallerError),
    ("has not yet answered earlier calls", BusyError),
    ("has left its network", BusyError),
    ("failed inside the device", RobotError),
    (": it has no ", ArgumentsError),
    (" is missing.", ArgumentsError),
)
"""Words of a text, the first that is found counts."""


class Describes(Protocol):
    """A network, or several, that describe their robots."""

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions; raises :class:`RefusalError`."""


def said(refusal: RefusalError) -> str:
    """Return a refusal in words, without the remedies that are for Python.

    The ids near an absent one stay.
    """
    if refusal.envelope:
        return text_of(refusal.envelope)
    if isinstance(refusal, UnreachableError):
        return f"The network does not carry this: {refusal.why}"
    if isinstance(refusal, ValueError):
        return refusal.why
    if isinstance(refusal, NoAnswerError):
        return f"{refusal.why.rstrip('.')}. It may still carry the call out."
    why = refusal.why if refusal.why.endswith((".", "!", "?")) else f"{refusal.why}."
    return f"{why} {refusal.remedy}" if isinstance(refusal, NoSuchRobotError) and refusal.remedy else why


def answer_to(refusal: RefusalError) -> Envelope:
    """Return a refusal as an answer of status error: the robot's own, or its words."""
    return refusal.envelope or error(said(refusal))


async def answered(call: Awaitable[Envelope]) -> Envelope:
    """Await a call; return a refusal as an answer of status error."""
    try:
        return await call
    except RefusalError as refusal:
        return answer_to(refusal)


def with_meaning(text: str) -> str:
    """Return a refusal of the mesh, with its meaning where it is a fixed word."""
    known = EXACT.get(text)
    return text if known is None else f"{text}: {known[1]}"


def near_verbs(network: Describes, robot: str, verb: str) -> str:
    """Return a sentence with the verbs of a robot that resemble an absent one."""
    from strands_robots.serving.advertised import verb_names  # noqa: PLC0415 - only a refusal needs it

    try:
        return near(verb, verb_names(network.describe(robot, anew=True)))
    except RefusalError:
        return ""


def refusal_of(robot: str, verb: str, answer: Mapping[str, Any]) -> RefusalError:
    """Return the exception for an answer of status error.

    Robots of ours name the part of their pipeline that refused, in ``refused``. An older robot's answer is known by its
    fields, and an answer of the mesh, which is a text, by its words.
    """
    said, why = answer.get("refused"), plain_text(text_of(dict(answer)), WHY_MAX) or "it gave no reason"
    stated = BY_REASON.get(said) if isinstance(said, str) else None
    if stated is not None:
        return stated(why, robot=robot, verb=verb, envelope=answer)
    if answer.get("code") in LEASE_CODES:
        return ControlError(why, robot=robot, verb=verb, envelope=answer)
    if answer.get("locked") is True:
        return LockoutError(why, robot=robot, verb=verb, envelope=answer)
    return refusal_of_text(robot, verb, why, answer)


def refusal_of_text(robot: str, verb: str, text: object, answer: Mapping[str, Any] | None = None) -> RefusalError:
    """Return the exception for a refusal that is a text."""
    why = plain_text(text, WHY_MAX)
    known = EXACT.get(why)
    if known is not None:
        return known[0](known[1], robot=robot, verb=verb, envelope=answer)
    cause = next((each for words, each in WORDS if words in why), RobotError)
    return cause(why.removeprefix("validation: ") or "it gave no reason", robot=robot, verb=verb, envelope=answer)
