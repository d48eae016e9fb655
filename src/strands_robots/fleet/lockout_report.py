"""Report of one robot's lockouts, on either network."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.safety.lockout import Lockout

TOO_MANY = "more stops than it can keep apart; resume --local at its own machine"


@dataclass(frozen=True, slots=True)
class LockoutReport:
    """Lockouts and status of one robot; ``problem`` is empty if it reports them.

    ``at`` is the time of the report in monotonic seconds.
    """

    name: str
    lockouts: tuple[Lockout, ...] = ()
    problem: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict, repr=False)
    round_trip_ms: float = 0.0
    at: float = field(default_factory=time.monotonic)


Resumed = tuple[bool, str]
"""Whether a robot is free now, and what it said."""


def before_resume(robot: LockoutReport) -> Resumed:
    """Return the outcome of a resume where none can be sent to a robot."""
    if robot.problem:
        return False, robot.problem
    if not robot.lockouts:
        return True, "was not locked"
    return False, TOO_MANY
