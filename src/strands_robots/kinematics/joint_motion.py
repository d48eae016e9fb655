"""Motions of joints that a robot states, between limits and without a model.

Nothing is known of the robot's shape, so the way is not checked for contacts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from strands_robots.kinematics.arm import ACCELERATION_RAD_S2, SLIDE_SPEED_M_S, Action, ArmState, JawMap, JointMap
from strands_robots.kinematics.motion import Motion, Segment
from strands_robots.kinematics.stated_joint import StatedJoint
from strands_robots.kinematics.trajectory import Bounds, timed
from strands_robots.policies.base import JOINT_SPEED_RAD_S
from strands_robots.utils import ValidationError

if TYPE_CHECKING:  # nothing here needs MuJoCo
    from strands_robots.kinematics.chain import Floats

CHECKED = "limits"
"""What the way of such a motion is checked for, as its answer says."""


@dataclass(frozen=True)
class StatedJoints:
    """The joints of one motion; positions are radians, of a slide metres."""

    joints: tuple[StatedJoint, ...]

    @property
    def maps(self) -> tuple[JointMap, ...]:
        """Maps of the joints to the robot's keys."""
        return tuple(JointMap(each.key, each.key, each.factor) for each in self.joints)

    @property
    def jaw(self) -> JawMap | None:
        """None: no joint is known to be a gripper."""
        return None

    @property
    def bounds(self) -> Bounds:
        """Speed and acceleration of each joint at full speed."""
        speeds = [
            min(JOINT_SPEED_RAD_S if each.turns else SLIDE_SPEED_M_S, each.speed / abs(each.factor))
            for each in self.joints
        ]
        return Bounds(np.array(speeds), np.full(len(speeds), ACCELERATION_RAD_S2))

    def state(self, observation: Mapping[str, float]) -> ArmState:
        """Return the positions in an observation.

        Raises:
            ValidationError: the observation lacks one of the joints.
        """
        missing = [each.name for each in self.joints if each.key not in observation]
        if missing:
            raise ValidationError(f"the joints {', '.join(missing)} could not be read.")
        return ArmState(np.array([each.radians(observation[each.observed]) for each in self.maps]), None)

    def told(self, targets: Mapping[str, float]) -> Floats:
        """Return the positions that the robot was told; NaN where that is not known."""
        return np.array([each.radians(targets.get(each.commanded, np.nan)) for each in self.maps])

    def action(self, positions: Floats) -> Action:
        """Return the targets of positions."""
        return {each.commanded: each.value(float(at)) for each, at in zip(self.maps, positions, strict=True)}

    def holding(self, state: ArmState, told: float) -> bool | None:
        """Return None: no joint is known to be a gripper."""
        return None

    def reached(self, state: ArmState | None, goal: Floats | None, wanted: Mapping[str, float]) -> dict[str, Any]:
        """Return ``reached``, the joints, and the greatest error in degrees and mm.

        ``checked`` says what the way was checked for.
        """
        fields: dict[str, Any] = {"reached": None, "error_mm": None, "error_deg": None, "checked": CHECKED}
        if state is None:
            return fields
        joints = {}
        for joint, at in zip(self.joints, state.joints, strict=True):
            off = abs(wanted.get(joint.name, at) - at)
            key, error = ("error_deg", np.degrees(off)) if joint.turns else ("error_mm", 1000 * off)
            fields[key] = max(fields[key] or 0.0, round(float(error), 2))
            joints[joint.name] = round(float(np.degrees(at)) if joint.turns else float(at), 3)
        return {**fields, "reached": {"joints": joints}}


def chosen(known: Sequence[StatedJoint], wanted: Mapping[str, float]) -> dict[StatedJoint, float]:
    """Return the joints that a caller names, and where they shall be (rad or m).

    Args:
        known: the joints of the robot.
        wanted: degrees by name or key, metres for a slide.

    Raises:
        ValidationError: an unknown joint, one that cannot be moved, or a position outside its limits.
    """
    by_name = {each.key: each for each in known} | {each.name: each for each in known}
    found: dict[StatedJoint, float] = {}
    for name, value in wanted.items():
        joint = by_name.get(name)
        if joint is None:
            raise ValidationError(f"joints must be of {', '.join(each.name for each in known)}; there is no {name}.")
        if joint in found:
            raise ValidationError(f"joints must name {joint.name} once.")
        found[joint] = joint.position(value)
    return found


def move_joints(
    goals: Mapping[StatedJoint, float],
    state: ArmState,
    still: Action,
    asked: Mapping[str, float],
    *,
    hz: float,
    speed: float,
) -> Motion:
    """Move joints on a straight line between their positions, at bounded speed.

    Args:
        goals: where each joint shall be (rad or m).
        state: where they are, in the same order.
        still: targets of what stays where it is; devices may want every key in an action.
        asked: what the caller asked for.
        hz: control rate.
        speed: share of full speed, above 0 to 1.
    """
    space, goal = StatedJoints(tuple(goals)), np.array(list(goals.values()))
    way = timed(np.array([state.joints, goal]), space.bounds.scaled(speed))
    frames = [{**still, **space.action(positions)} for positions in way.sampled(hz)]
    return Motion(
        space,
        "moveJoints",
        {"joints": dict(asked)},
        [Segment("move", frames, settles=True)],
        hz,
        end_joints=goal,
        wanted={joint.name: at for joint, at in goals.items()},
    )
