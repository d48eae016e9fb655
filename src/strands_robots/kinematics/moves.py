"""Motions of an arm to joints, to a point, along a line, and of its gripper.

Each function raises :class:`~strands_robots.utils.ValidationError` with the reason why the motion cannot be.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from strands_robots.kinematics.arm import Action, Arm, ArmState
from strands_robots.kinematics.chain import Floats
from strands_robots.kinematics.motion import Motion, Segment
from strands_robots.kinematics.objects import Held, SeenObject
from strands_robots.kinematics.obstacles import beside
from strands_robots.kinematics.planner import Planner
from strands_robots.kinematics.trajectory import Bounds, joined, timed
from strands_robots.utils import ValidationError

JAW_S = 0.8
"""Seconds in which the gripper crosses its whole range."""

DIRECTIONS = {
    "forward": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
"""Directions by word, in the base frame."""


@dataclass(frozen=True)
class Start:
    """Beginning of a motion, and how it is played.

    Attributes:
        state: the arm's present state.
        hz: control rate.
        speed: share of full speed, above 0 to 1.
        objects: those that the motion goes around.
        held: the object between the jaws.
        going: false once the motion is not wanted any more.
    """

    arm: Arm
    state: ArmState
    hz: float
    speed: float
    objects: Sequence[SeenObject] = ()
    held: Held | None = None
    going: Callable[[], bool] = lambda: True

    @property
    def bounds(self) -> Bounds:
        """Speed and acceleration of each joint."""
        return self.arm.bounds.scaled(self.speed)

    def planner(self, opening: float | None = None, *, besides: Collection[str] = (), carries: bool = True) -> Planner:
        """Return a planner from the present joints.

        Args:
            opening: of the gripper; the present one by default.
            besides: names of objects that are no obstacles.
            carries: false to leave the held object out.
        """
        jaw = self.arm.jaw_radians(self.state.opening if opening is None else opening)
        held = self.held
        names = {*besides, *(() if held is None else (held.name,))}
        obstacles = [each for each in self.objects if each.name not in names]
        chain = beside(self.arm.chain, obstacles, held if carries and self.objects else None)
        return Planner(chain, self.state.joints, jaw, self.going)

    def frames(self, legs: Sequence[Floats]) -> list[Action]:
        """Return the setpoints of joint paths, one after another."""
        if not legs:
            return []
        trajectory = joined([timed(leg, self.bounds) for leg in legs])
        return [self.arm.action(joints) for joints in trajectory.sampled(self.hz)]

    def jaw_frames(self, before: float, after: float) -> list[Action]:
        """Return the setpoints of the gripper from one opening to another."""
        steps = max(1, int(np.ceil(abs(after - before) * JAW_S * self.hz)))
        return [self.arm.grip(before + (after - before) * (index + 1) / steps) for index in range(steps)]


def move_joints(start: Start, degrees: Mapping[str, float]) -> Motion:
    """Move joints to positions in degrees (metres for a slide), by name."""
    turns = {joint.name: joint.turns for joint in start.arm.chain.joints}
    planner = start.planner()
    targets = {name: float(np.radians(at)) if turns.get(name, True) else at for name, at in degrees.items()}
    motion = _to(start, "moveJoints", {"joints": dict(degrees)}, planner, planner.joints(targets))
    return replace(motion, wanted=targets)


def go_to(start: Start, place: str, degrees: Mapping[str, float]) -> Motion:
    """Move to the joints of a place."""
    return replace(move_joints(start, degrees), verb="goTo", asked={"place": place})


def move_to(start: Start, position: Floats, approach: float | None) -> Motion:
    """Move the tip to a point (m), by an approach in degrees or the steepest."""
    planner = start.planner()
    reached = planner.reach(position, approach)
    x, y, z = (float(v) for v in position)
    asked = {"x": x, "y": y, "z": z, "approach": round(reached.approach_deg, 1)}
    return _to(start, "moveTo", asked, planner, reached.joints)


def move_by(start: Start, offset: Floats) -> Motion:
    """Move the tip by an offset (m) on a straight line, with the same approach."""
    planner = start.planner()
    before = start.arm.chain.forward(planner.start).position
    path = planner.line(before + offset)
    dx, dy, dz = (float(v) for v in offset)
    segments = [Segment("move", start.frames([path]), settles=True)]
    return Motion(start.arm, "moveBy", {"dx": dx, "dy": dy, "dz": dz}, segments, start.hz, before + offset)


def set_gripper(start: Start, opening: float) -> Motion:
    """Move the gripper to an opening from 0 (closed) to 1 (open)."""
    before = require_gripper(start)
    segments = [Segment("gripper", start.jaw_frames(before, opening), settles=True)]
    return Motion(start.arm, "setGripper", {"opening": opening}, segments, start.hz, told=opening)


def require_gripper(start: Start) -> float:
    """Return the present opening. Raises :class:`ValidationError` without a gripper."""
    if start.state.opening is None:
        raise ValidationError(f"{start.arm.chain.label} has no gripper.")
    return start.state.opening


def _to(start: Start, verb: str, asked: Mapping[str, Any], planner: Planner, joints: Floats) -> Motion:
    segments = [Segment("move", start.frames(planner.path(joints)), settles=True)]
    return Motion(start.arm, verb, asked, segments, start.hz, start.arm.chain.forward(joints).position)
