"""How far a Reachy Mini may be asked to go, and how fast.

The daemon applies a target out of its reach not at all and tells nobody, so it is refused here, by name. The bounds lie
inside the measured reach of the daemon's own inverse kinematics and motor limits (1.13.0): roll +-47 degrees, pitch
-72 to +48, x -46 to +50 mm, y +-47 mm, z -50 to +23 mm, with corners such as pitch 40 and roll 40 unsolvable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from strands_robots.drivers.reachy.pose import HeadPose
from strands_robots.utils import ValidationError, number

TILT = math.radians(40)
TILT_SUM = math.radians(60)
HEAD_YAW = math.pi
BODY_YAW = math.radians(160)
NECK_YAW = math.radians(65)
SIDEWAYS_M = 0.025
DOWN_M, UP_M = 0.030, 0.015
ANTENNA = math.pi
SHORTEST_S, LONGEST_S = 0.1, 60.0
STREAM_HZ = 50.0
FRAME_STEP = 0.3
RAMP_STEP = 0.1
FRAME_STEP_M = 0.01

INIT_ANTENNAS = (-0.1745, 0.1745)
SLEEP_ANTENNAS = (-3.05, 3.05)
"""Rest positions, right then left, radians (the daemon's own constants)."""

HEAD_KEYS = ("head_x", "head_y", "head_z", "head_roll", "head_pitch", "head_yaw")
ACTION_KEYS = (*HEAD_KEYS, "body_yaw", "antenna_right", "antenna_left")

BOUNDS = {
    "head_x": (-SIDEWAYS_M, SIDEWAYS_M),
    "head_y": (-SIDEWAYS_M, SIDEWAYS_M),
    "head_z": (-DOWN_M, UP_M),
    "head_roll": (-TILT, TILT),
    "head_pitch": (-TILT, TILT),
    "head_yaw": (-HEAD_YAW, HEAD_YAW),
    "body_yaw": (-BODY_YAW, BODY_YAW),
    "antenna_right": (-ANTENNA, ANTENNA),
    "antenna_left": (-ANTENNA, ANTENNA),
}
"""Lowest and highest value of every action key, metres and radians."""

_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Target:
    """Where the robot shall be: any of the head, the body's yaw and the antennas (right, left); metres and radians."""

    head: HeadPose | None = None
    body_yaw: float | None = None
    antennas: tuple[float, float] | None = None

    def over(self, below: Target) -> Target:
        """This target with what it leaves open taken from ``below``."""
        return Target(
            self.head if self.head is not None else below.head,
            self.body_yaw if self.body_yaw is not None else below.body_yaw,
            self.antennas if self.antennas is not None else below.antennas,
        )

    def step_from(self, start: Target) -> float:
        """The largest share of a frame's allowed step between ``start`` and this: 1.0 is just one frame's."""
        steps = [0.0]
        if self.head and start.head:
            # The angles' sum bounds the turn and, unlike it, divides evenly over the frames of a ramp; and the body
            # follows the head's yaw, so that a turn through the back is as long as it is.
            steps.append(self.head.turn_to(start.head) / FRAME_STEP)
            steps.append(self.head.distance_to(start.head) / FRAME_STEP_M)
        if self.body_yaw is not None and start.body_yaw is not None:
            steps.append(abs(self.body_yaw - start.body_yaw) / FRAME_STEP)
        if self.antennas and start.antennas:
            steps.extend(abs(a - b) / FRAME_STEP for a, b in zip(self.antennas, start.antennas, strict=True))
        return max(steps)

    def toward(self, end: Target, share: float) -> Target:
        """``share`` (0 to 1) of the way to ``end``, in the parts that ``end`` has."""
        if share >= 1:
            return end
        head, body, antennas = end.head, end.body_yaw, end.antennas
        if head and self.head:
            head = self.head.toward(head, share)
        if body is not None and self.body_yaw is not None:
            body = self.body_yaw + (body - self.body_yaw) * share
        if antennas and self.antennas:
            right, left = (a + (b - a) * share for a, b in zip(self.antennas, antennas, strict=True))
            antennas = (right, left)
        return Target(head, body, antennas)

    def action(self) -> dict[str, float]:
        """The parts as action keys."""
        found: dict[str, float] = {}
        if self.head:
            found.update({key: getattr(self.head, key.removeprefix("head_")) for key in HEAD_KEYS})
        if self.body_yaw is not None:
            found["body_yaw"] = self.body_yaw
        if self.antennas:
            found["antenna_right"], found["antenna_left"] = self.antennas
        return found


def bounded(key: str, value: object, *, unit: str = "", scale: float = 1.0, name: str = "") -> float:
    """``value`` in metres or radians, refused outside the bounds of an action key.

    ``scale`` is the number of caller's units in a metre or radian and ``unit`` their name, so that a refusal speaks
    in the units it was asked in.
    """
    low, high = (bound * scale for bound in BOUNDS[key])
    label = f"{name or key} ({unit})" if unit else name or key
    # A bound is not missed by the last digit of a conversion between degrees and radians.
    slack = _ROUNDING * max(1.0, scale)
    if isinstance(value, int | float) and not isinstance(value, bool) and low - slack <= value <= high + slack:
        return min(high, max(low, float(value))) / scale
    return number(label, value, low=round(low, 6), high=round(high, 6)) / scale


def check(target: Target, *, automatic_body_yaw: bool, body_yaw: float | None = None) -> Target:
    """``target`` itself when the daemon can reach it as a whole.

    Raises:
        ValidationError: pitch and roll are too large together, or (only with automatic body yaw off, when the daemon
            does not turn the body along) head and body are turned more than 65 degrees apart. ``body_yaw`` is where
            the body is when the target does not say.
    """
    head = target.head
    if head is not None and abs(head.pitch) + abs(head.roll) > TILT_SUM + _ROUNDING:
        tilt = math.degrees(abs(head.pitch) + abs(head.roll))
        raise ValidationError(f"pitch and roll must together be at most 60 degrees, not {tilt:g}.")
    body = target.body_yaw if target.body_yaw is not None else body_yaw
    if head is not None and body is not None and not automatic_body_yaw and abs(head.yaw - body) > NECK_YAW + _ROUNDING:
        apart = math.degrees(abs(head.yaw - body))
        raise ValidationError(
            f"head yaw and body yaw must be at most 65 degrees apart while automatic body yaw is off, not {apart:.4g}."
        )
    return target


def from_action(action: dict[str, object], start: Target) -> Target:
    """The target of an action in metres and radians; head numbers that it leaves out come from ``start``.

    Raises:
        ValidationError: an unknown key, an empty action, or a value out of its bounds.
    """
    if not isinstance(action, dict) or not action:
        raise ValidationError(f"action must be an object with keys of {', '.join(ACTION_KEYS)}.")
    if unknown := sorted(set(map(str, action)) - set(ACTION_KEYS)):
        raise ValidationError(f"action has no key {unknown[0]!r}; there are {', '.join(ACTION_KEYS)}.")
    values = {key: bounded(key, value) for key, value in action.items()}
    head = None
    if any(key in values for key in HEAD_KEYS):
        below = start.head or HeadPose()
        head = HeadPose(*(values.get(key, getattr(below, key.removeprefix("head_"))) for key in HEAD_KEYS))
    antennas = None
    if "antenna_right" in values or "antenna_left" in values:
        right, left = start.antennas or INIT_ANTENNAS
        antennas = (values.get("antenna_right", right), values.get("antenna_left", left))
    return Target(head, values.get("body_yaw"), antennas)
