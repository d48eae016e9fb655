"""Facts of an arm without numpy: its parts, and the joints that it states."""

from __future__ import annotations

import math
from dataclasses import dataclass

from strands_robots.utils import ValidationError


@dataclass(frozen=True, slots=True)
class ArmParts:
    """Parts of an arm that a body has.

    Attributes:
        joints: some joint is moved to positions.
        model: where the tip is can be computed.
        tip: the tip can be moved to a point.
        jaws: a gripper opens and closes.
    """

    joints: bool = False
    model: bool = False
    tip: bool = False
    jaws: bool = False

    def verbs(self, *, sees: bool) -> frozenset[str]:
        """Return the names of the verbs that these parts carry out.

        Args:
            sees: objects are known, or a detector sees them.
        """
        places = self.joints and self.model
        needs = {
            "moveJoints": self.joints,
            "getPose": self.model,
            "goTo": places,
            "savePlace": places,
            "moveTo": self.tip,
            "moveBy": self.tip,
            "setGripper": self.jaws,
            "pick": self.tip and self.jaws,
            "place": self.tip and self.jaws,
            "getObjects": self.model and sees,
        }
        verbs = {name for name, has in needs.items() if has}
        return frozenset(verbs | {"wait"} if verbs - {"getPose", "getObjects"} else verbs)


_SLACK = 1e-6
"""Greatest distance beyond a limit that is a rounding, in degrees or metres."""


@dataclass(frozen=True, slots=True)
class StatedJoint:
    """One joint of a robot without a model.

    Attributes:
        name: as callers name it.
        key: in observations and actions of the robot.
        turns: it turns, and is told in degrees; else it slides, and is told in metres.
        low: lowest position, in degrees or metres.
        high: highest position.
        factor: the robot's units in one radian or metre.
        speed: greatest speed in the robot's units a second; infinite where none is stated.
        refusal: why it cannot be moved to a position; empty where it can.
    """

    name: str
    key: str
    turns: bool = True
    low: float = -math.inf
    high: float = math.inf
    factor: float = 1.0
    speed: float = math.inf
    refusal: str = ""

    def position(self, value: float) -> float:
        """Return a position of a caller in radians, of a slide in metres.

        Raises:
            ValidationError: the joint cannot be moved, or not there.
        """
        if self.refusal:
            raise ValidationError(f"{self.name} cannot be moved to a position: {self.refusal}.")
        if not self.low - _SLACK <= value <= self.high + _SLACK:
            unit = "degrees" if self.turns else "m"
            raise ValidationError(f"{self.name} must be from {self.low:g} to {self.high:g} {unit}, not {value:g}.")
        return math.radians(value) if self.turns else value
