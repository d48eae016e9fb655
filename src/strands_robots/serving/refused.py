"""Refusals of a command: the part of the pipeline that refused it, and why."""

from __future__ import annotations

from enum import Enum

from strands_robots.envelope import Envelope, error
from strands_robots.errors import StrandsRobotsError


class RefusalReason(Enum):
    """The part of the pipeline that refused a command."""

    ARGUMENTS = "arguments"
    CALLER = "caller"
    CONTROL = "control"
    LOCKOUT = "lockout"
    APPROVAL = "approval"
    BUSY = "busy"
    FAILED = "failed"

    def noted(self, envelope: Envelope) -> Envelope:
        """Return the envelope with the part that refused, for callers that are programs."""
        return {**envelope, "refused": self.value}


class Refused(StrandsRobotsError):  # noqa: N818 - a refusal, not a fault
    """A command that did not reach the robot, or failed in it.

    Args:
        text: what the caller is told.
        reason: what the audit is told; ``text`` by default.
        envelope: the whole answer, where it is more than ``text``.
    """

    def __init__(self, why: RefusalReason, text: str, reason: str = "", envelope: Envelope | None = None) -> None:
        super().__init__(text)
        self.why = why
        self.reason = reason or text
        self.envelope = why.noted(error(text) if envelope is None else envelope)
