"""Answers of robots as exceptions of :mod:`strands_robots.errors`.

Robots of ours name the part of their pipeline that refused, in ``refused``. An older robot's answer is known by its
fields, and an answer of the mesh, which is a text, by its words.
"""

from __future__ import annotations

from collections.abc import Awaitable, Mapping
from typing import Any, Protocol

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
from strands_robots.utils import near, plain_text

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
    """Return the exception for an answer of status error."""
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
