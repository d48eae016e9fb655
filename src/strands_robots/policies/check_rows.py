"""Rows of the check of a policy, and the robot's side of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from strands_robots.policies.base import Ranges
from strands_robots.policies.checkpoint import Size

Outcome = Literal["ok", "confirmed", "unverified", "refused"]

PROFILE, ROBOT = "profile", "robot"
"""Owners of values beside the sources on disk."""


def of(value: object, owner: str) -> str:
    """Return a value with its owner."""
    return f"{value} ({owner})"


def converted(value: float, unit: str | None, to: str | None) -> float:
    """Return a value in another unit; unchanged where there is no conversion."""
    if unit == "radians" and to == "degrees":
        return math.degrees(value)
    return math.radians(value) if unit == "degrees" and to == "radians" else value


@dataclass(frozen=True)
class RobotFacts:
    """Facts of a robot, for the check.

    Attributes:
        state: present values of what it observes, by key.
        action: its action keys.
        units: unit by key, where it is known.
        cameras: size by name; None for one that draws any size.
        rate: its control rate in Hz.
        ranges: lowest and highest target by action key.
        kind: its type, such as ``so101_follower``; empty where it is not known.
    """

    name: str
    state: Mapping[str, float]
    action: Sequence[str]
    units: Mapping[str, str] = field(default_factory=dict)
    cameras: Mapping[str, Size | None] = field(default_factory=dict)
    rate: float = 50.0
    ranges: Ranges = field(default_factory=dict)
    kind: str = ""


@dataclass(frozen=True)
class CheckRow:
    """One question: both sides, the outcome, and the line of the profile to change.

    Attributes:
        blocks: the robot may not move while the row is unverified.
    """

    question: str
    policy: str
    robot: str
    outcome: Outcome
    change: str = ""
    blocks: bool = True


def compared(question: str, policy: str, robot: str, fits: bool, change: str) -> CheckRow:
    """Return the row of two values that are both stated."""
    return CheckRow(question, policy, robot, "ok" if fits else "refused", "" if fits else change)


def unanswered(question: str, policy: str = "not stated", robot: str = "-", change: str = "") -> CheckRow:
    """Return the row of a question that no source answers; it blocks no motion."""
    return CheckRow(question, policy, robot, "unverified", change or "look at it yourself", blocks=False)
