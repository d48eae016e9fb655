"""Motions of an arm to joints, a point, along a line, to pick and to place.

Each function raises :class:`~strands_robots.utils.ValidationError` with the reason why the motion cannot be.

The object goes beside the jaw that stands still, and the other jaw closes on it: hover, straight down, close, straight
up. Of the ways to grasp it the steepest that is free of contact is taken.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from strands_robots.kinematics.arm import Action, Arm, ArmState, Bounds, joined, timed
from strands_robots.kinematics.chain import Chain, Floats
from strands_robots.kinematics.motion import Motion, Segment
from strands_robots.kinematics.objects import Held, SeenObject, beside
from strands_robots.kinematics.planner import APPROACH_STEP_DEG, Planner, rolled
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
    return Motion(start.arm, "setGripper", {"opening": opening}, segments, start.hz, opening=opening)


def require_gripper(start: Start) -> float:
    """Return the present opening. Raises :class:`ValidationError` without a gripper."""
    if start.state.opening is None:
        raise ValidationError(f"{start.arm.chain.label} has no gripper.")
    return start.state.opening


def _to(start: Start, verb: str, asked: Mapping[str, Any], planner: Planner, joints: Floats) -> Motion:
    segments = [Segment("move", start.frames(planner.path(joints)), settles=True)]
    return Motion(start.arm, verb, asked, segments, start.hz, start.arm.chain.forward(joints).position)


HOVER_M = (0.07, 0.05, 0.03)
"""Heights above the grasp from which the gripper goes straight down; the first that is reachable."""

CLEAR_M = (0.03, 0.06, 0.1)
"""Distances beyond that by which the gripper gets clear of a tall object; the first that is enough."""

PAD_GAP_M = 0.004
"""Distance between the object and the jaw that stands still, before the other closes."""

OPEN_MORE_M = 0.015
"""How much wider than the object the jaws are opened; wide open they touch the floor on tilted approaches."""

TIP_LOWEST_M = 0.012
"""Lowest tip above the table; the jaws reach a little further."""

RELEASE_M = 0.002
"""Height above its place from which an object is let go."""

SHALLOWEST_DEG = 30.0

_TIP_STEP_M = 0.003
_GAP_STEPS = 41


@dataclass(frozen=True, slots=True)
class _Grip:
    """Jaws across an object: the closing direction and the object's width along it."""

    closing: Floats
    width: float


def pick(start: Start, target: SeenObject, approach: float | None) -> tuple[Motion, Held]:
    """Plan to pick an object up.

    Raises:
        ValidationError: it is too wide, or no free way leads to it.
    """
    before = require_gripper(start)
    if target.fixed:
        raise ValidationError(f"{target.name} is fixed and cannot be picked up.")
    opening = _opening_for(start, target)
    planner, past = start.planner(opening, besides=(target.name,)), start.planner(opening)
    for degrees, grip in itertools.product(_approaches(approach), _grips(target)):
        found = _grasp(planner, target, grip, degrees)
        if found is None:
            continue
        way, tip = found
        try:
            # Only the last part of the way, between the jaws, may touch the object.
            way = _cleared(planner, past, way)
            legs = past.path(way[-1])
        except ValidationError:
            continue
        segments = [
            Segment("open", start.jaw_frames(before, opening)),
            Segment("hover", start.frames(legs), settles=True),
            Segment("down", start.frames([way[::-1]]), settles=True),
            Segment("close", start.jaw_frames(opening, 0.0), settles=True),
            Segment("lift", start.frames([way]), settles=True),
        ]
        pose = start.arm.chain.forward(way[0])
        held = Held(
            target.name,
            pose.rotation.T @ (target.position - tip),
            float(target.size[2]) / 2,
            grip.width,
            pose.approach_deg,
            float(min(target.size[0], target.size[1])) / 2,
            target.size / 2,
            pose.rotation.T @ _turned(target.yaw),
            target.round,
        )
        goal = start.arm.chain.forward(way[-1]).position
        asked = {"object": target.name, **_point(target.position), "approach": degrees}
        motion = Motion(start.arm, "pick", asked, segments, start.hz, goal, way[-1], opening=0.0, grasps=True)
        return motion, held
    # The refusal is that of the steepest reach to the object's centre, or it is the way that is blocked.
    planner.reach(target.position + np.array([0.0, 0.0, 0.02]), approach)
    raise ValidationError(f"no way to grasp {target.name} at {_shown(target.position)} is free of contact.")


def place(start: Start, position: Floats, approach: float | None, held: Held, on: str = "") -> Motion:
    """Plan to put the held object down with its bottom at ``position``.

    It is put on the object ``on``, or on the table where that is empty.

    Raises:
        ValidationError: no free way leads there.
    """
    require_gripper(start)
    chain = start.arm.chain
    # Between the jaws it may touch what it is put on; on the way there it goes around everything.
    planner, carrying = start.planner(besides=(on,), carries=False), start.planner()
    centre = position + np.array([0.0, 0.0, held.below + RELEASE_M])
    wanted = [approach] if approach is not None else sorted(_approaches(None), key=lambda d: abs(d - held.approach_deg))
    release = _share_of(chain, held.width + OPEN_MORE_M)
    opened = start.planner(release, besides=(on,), carries=False)
    for degrees in wanted:
        way = _lowering(planner, centre, degrees, held)
        # The jaws open beside what stands around the place.
        if way is None or any(opened.meets(joints, objects=True) for joints in way):
            continue
        try:
            legs = carrying.path(way[-1])
        except ValidationError:
            continue
        segments = [
            Segment("carry", start.frames(legs), settles=True),
            Segment("down", start.frames([way[::-1]]), settles=True),
            Segment("open", start.jaw_frames(start.state.opening or 0.0, release), settles=True),
            Segment("up", start.frames([way]), settles=True),
        ]
        goal = chain.forward(way[-1]).position
        asked = {"object": held.name, **_point(position), "approach": degrees}
        return Motion(start.arm, "place", asked, segments, start.hz, goal, opening=release)
    planner.reach(centre, approach)
    raise ValidationError(f"no way to put {held.name or 'it'} down at {_shown(position)} is free of contact.")


def jaw_gap(chain: Chain, opening: float) -> float:
    """Return the metres between the jaws at the tip; infinite where they pass it."""
    gripper = chain.gripper
    if gripper is None:
        return 0.0
    joint = gripper.joint
    data = chain.data(chain.rest, joint.low + (joint.high - joint.low) * opening)
    rotation = data.site_xmat[chain.site].reshape(3, 3)
    closing = rotation @ gripper.closing
    # From the face of the jaw that stands still; from the tip where both move.
    origin = data.site_xpos[chain.site] + closing * max(gripper.pad_m - 5e-4, 0.0)
    hit = np.zeros(1, dtype=np.int32)
    distance = float(mujoco.mj_ray(chain.model, data, origin, -closing, None, 0, -1, hit))
    if distance < 0:
        return float("inf")
    return distance if gripper.pad_m > 0 else 2 * distance


def _share_of(chain: Chain, gap: float) -> float:
    """Return the smallest opening with at least this gap, else wide open."""
    return next((float(s) for s in np.linspace(0.0, 1.0, _GAP_STEPS) if jaw_gap(chain, float(s)) >= gap), 1.0)


def _opening_for(start: Start, target: SeenObject) -> float:
    narrowest = min(grip.width for grip in _grips(target))
    widest = max(
        gap for gap in (jaw_gap(start.arm.chain, s) for s in np.linspace(0, 1, _GAP_STEPS)) if np.isfinite(gap)
    )
    if narrowest + 2 * PAD_GAP_M > widest:
        raise ValidationError(
            f"{target.name} is {1000 * narrowest:.0f} mm wide, and the gripper opens {1000 * widest:.0f} mm."
        )
    fitting = [grip.width for grip in _grips(target) if grip.width + 2 * PAD_GAP_M <= widest]
    return _share_of(start.arm.chain, min(max(fitting) + PAD_GAP_M + OPEN_MORE_M, widest))


def _approaches(asked: float | None) -> list[float]:
    return [asked] if asked is not None else [float(d) for d in np.arange(90.0, SHALLOWEST_DEG - 1, -APPROACH_STEP_DEG)]


def _grips(target: SeenObject) -> list[_Grip]:
    """Return the ways to close across an object, the narrowest first."""
    turns = np.arange(4) * np.pi / 4 if target.round else np.array([0.0, np.pi / 2])
    widths = [float(target.size[0 if target.round or index == 0 else 1]) for index in range(len(turns))]
    grips = []
    for turn, width in sorted(zip(turns, widths, strict=True), key=lambda pair: pair[1]):
        angle = target.yaw + turn
        across = np.array([np.cos(angle), np.sin(angle), 0.0])
        grips += [_Grip(across, width), _Grip(-across, width)]
    return grips


def _grasp(planner: Planner, target: SeenObject, grip: _Grip, degrees: float) -> tuple[Floats, Floats] | None:
    """Return the joint path from the grasp straight up, and the tip of the grasp."""
    chain = planner.chain
    gripper = chain.gripper
    if gripper is None:
        return None
    for height in _heights(planner, target):
        centre = target.position.copy()
        centre[2] = height
        direction = planner.direction(centre, degrees)
        across = grip.closing - direction * float(direction @ grip.closing)
        across /= max(float(np.linalg.norm(across)), 1e-6)
        if abs(float(across @ grip.closing)) < np.cos(np.radians(25.0)):
            return None
        beside = grip.width / 2 + PAD_GAP_M - gripper.pad_m if gripper.pad_m > 0 else 0.0
        tip = centre + across * beside
        found = planner.find(tip, degrees)
        if found is None:
            continue
        joints = rolled(chain, found.joints, across)
        if joints is None or not planner.free(joints):
            continue
        way = _upwards(planner, joints, tip)
        if way is not None:
            return way, tip
    return None


def _heights(planner: Planner, target: SeenObject) -> Iterator[float]:
    """Yield heights of the tip, from the object's middle up to its top."""
    top = float(target.position[2] + target.size[2] / 2)
    lowest = max(float(target.position[2]), planner.chain.table_z + TIP_LOWEST_M)
    for height in np.arange(lowest, max(top, lowest + 1e-6), _TIP_STEP_M):
        yield float(height)


def _lowering(planner: Planner, centre: Floats, degrees: float, held: Held) -> Floats | None:
    """Return the joint path straight up from where the held object is at ``centre``."""
    tip = centre.copy()
    for _ in range(4):
        found = planner.find(tip, degrees)
        if found is None:
            return None
        # The object stays where it is between the jaws, so the tip's place depends on how the jaws are turned.
        tip = centre - planner.chain.forward(found.joints).rotation @ held.offset
    found = planner.find(tip, degrees)
    return None if found is None else _upwards(planner, found.joints, tip)


def _upwards(planner: Planner, joints: Floats, tip: Floats) -> Floats | None:
    for height in HOVER_M:
        direction = planner.chain.forward(joints).approach
        try:
            return planner.line(tip + np.array([0.0, 0.0, height]), joints, direction)
        except ValidationError:
            continue
    return None


def _cleared(planner: Planner, past: Planner, way: Floats) -> Floats:
    """Return a way from the grasp to where the gripper is clear of the object.

    Raises:
        ValidationError: neither higher nor back along the approach is clear of it.
    """
    if past.free(way[-1]):
        return way
    pose = planner.chain.forward(way[-1])
    for distance in CLEAR_M:
        for direction in (np.array([0.0, 0.0, 1.0]), -pose.approach):
            try:
                further = planner.line(pose.position + distance * direction, way[-1], pose.approach)
            except ValidationError:
                continue
            if past.free(further[-1]):
                return np.concatenate([way, further[1:]])
    raise ValidationError("no pose before the grasp is clear of the object.")


def _turned(yaw: float) -> Floats:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _point(position: Floats) -> dict[str, float]:
    return {axis: round(float(value), 4) for axis, value in zip("xyz", position, strict=True)}


def _shown(position: Floats) -> str:
    return f"({', '.join(f'{value:.3f}' for value in position)}) m"
