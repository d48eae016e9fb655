"""An arm of a body: its joints by the body's numbers, and joint trajectories."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from strands_robots.kinematics import ArmParts
from strands_robots.policies.base import JOINT_SPEED_RAD_S
from strands_robots.utils import DURATION_MAX_S, ValidationError

if TYPE_CHECKING:  # MuJoCo is not needed to time a path of joints
    from strands_robots.kinematics.chain import ArmJoint, Chain, Floats

_GRID = 400
"""Points of a trajectory; between them it is straight."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Greatest speed (rad/s or m/s) and acceleration of each joint."""

    speed: Floats
    acceleration: Floats

    def scaled(self, share: float) -> Bounds:
        """Return the bounds of a motion at a share of full speed."""
        return Bounds(self.speed * share, self.acceleration * share)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Joint positions (n, joints) at times (n) in seconds from 0."""

    times: Floats
    points: Floats

    @property
    def duration(self) -> float:
        """Seconds from the start to the end."""
        return float(self.times[-1])

    def at(self, seconds: float) -> Floats:
        """Return the positions at a time; before the start and after the end those of it."""
        return np.array([np.interp(seconds, self.times, column) for column in self.points.T])

    def sampled(self, hz: float) -> Floats:
        """Return the setpoints of each control step after the first, the end included.

        Raises:
            ValidationError: the motion is so slow that it would last longer than an hour.
        """
        if not self.duration <= DURATION_MAX_S:  # also where it cannot be computed
            raise ValidationError(
                f"speed must let the motion end within {DURATION_MAX_S:g} s, not in {self.duration:.3g} s."
            )
        steps = int(np.ceil(self.duration * hz - 1e-9))
        return np.array([self.at((index + 1) / hz) for index in range(steps)]).reshape(steps, self.points.shape[1])


def timed(path: Floats, bounds: Bounds) -> Trajectory:
    """Time a path of joint positions (n, joints) by a minimum-jerk profile.

    The path is a straight line between two points, else a smooth curve through all.
    """
    steps = np.abs(np.diff(path, axis=0)) / bounds.speed
    lengths = np.concatenate([[0.0], np.cumsum(steps.max(axis=1))])
    keep = np.concatenate([[True], np.diff(lengths) > 1e-9])
    lengths, path = lengths[keep], path[keep]
    if len(path) < 2:
        return Trajectory(np.zeros(1), path[:1])
    share = np.linspace(0.0, 1.0, _GRID)
    travelled = share**3 * (share * (6 * share - 15) + 10) * lengths[-1]
    points = _curve(lengths, path, travelled)
    step = share[1]
    velocity = np.abs(np.diff(points, axis=0)) / step
    acceleration = np.abs(np.diff(points, n=2, axis=0)) / step**2
    seconds = max(float((velocity / bounds.speed).max()), float(np.sqrt((acceleration / bounds.acceleration).max())))
    return Trajectory(share * seconds, points)


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return trajectories one after another; each starts where the one before ends."""
    ends = np.concatenate([[0.0], np.cumsum([part.duration for part in parts])])
    times = np.concatenate([part.times + end for part, end in zip(parts, ends[:-1], strict=True)])
    return Trajectory(times, np.concatenate([part.points for part in parts]))


def _curve(lengths: Floats, path: Floats, at: Floats) -> Floats:
    """Return the cubic spline through ``path``, a line for two points."""
    if len(path) == 2:
        straight: Floats = path[0] + (at / lengths[-1])[:, None] * (path[1] - path[0])
        return straight
    gaps = np.diff(lengths)
    slopes = np.diff(path, axis=0) / gaps[:, None]
    count = len(path)
    system, right = np.eye(count), np.zeros_like(path)
    for i in range(1, count - 1):
        system[i, i - 1 : i + 2] = gaps[i - 1], 2 * (gaps[i - 1] + gaps[i]), gaps[i]
        right[i] = 6 * (slopes[i] - slopes[i - 1])
    bends = np.linalg.solve(system, right)
    index = np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, count - 2)
    into = (at - lengths[index])[:, None]
    gap = gaps[index][:, None]
    first = slopes[index] - gap * (2 * bends[index] + bends[index + 1]) / 6
    result: Floats = path[index] + into * (
        first + into * (bends[index] / 2 + into * (bends[index + 1] - bends[index]) / (6 * gap))
    )
    return result


ACCELERATION_RAD_S2 = 8.0
"""Bound of a planned motion at full speed."""

GRIP_MARGIN = 0.03
"""Share of the gripper's range by which an object keeps the jaws from where they are told to go."""

SLIDE_SPEED_M_S = 0.25
"""Greatest speed of a sliding joint in a planned motion."""

SAG_RAD = 0.06
"""Greatest distance of a resting joint from where it was told to be."""

Action = dict[str, float]
"""Targets by action key, in the body's own units."""


@dataclass(frozen=True, slots=True)
class JointMap:
    """Linear map of one joint: ``value = offset + factor * radians``.

    Attributes:
        observed: key of the joint in an observation of the body.
        commanded: its action key.
        modelled: an observation is in the model's own unit, and only a command is mapped.
    """

    observed: str
    commanded: str
    factor: float = 1.0
    offset: float = 0.0
    modelled: bool = False

    def position(self, observed: float) -> float:
        """Return the joint position of an observation."""
        return observed if self.modelled else self.radians(observed)

    def value(self, radians: float) -> float:
        """Return the command of a joint position."""
        return self.offset + self.factor * radians

    def radians(self, value: float) -> float:
        """Return the joint position of a command."""
        return (value - self.offset) / self.factor


@dataclass(frozen=True, slots=True)
class JawMap:
    """Keys of the gripper, and its closed and open values."""

    observed: str
    commanded: str
    observed_range: tuple[float, float]
    commanded_range: tuple[float, float]

    def opening(self, observed: float) -> float:
        """Return an observation as an opening from 0 (closed) to 1 (open)."""
        closed, opened = self.observed_range
        return (observed - closed) / (opened - closed)

    def says(self, command: float, opening: float) -> bool:
        """True where a command is that of an opening."""
        return abs(command - self.command(opening)) <= 1e-3 * abs(self.commanded_range[1] - self.commanded_range[0])

    def command(self, opening: float) -> float:
        """Return the command of an opening."""
        closed, opened = self.commanded_range
        return closed + (opened - closed) * opening


@dataclass(frozen=True, slots=True)
class ArmState:
    """Joint positions (rad), and the gripper's opening from 0 to 1, None without one."""

    joints: Floats
    opening: float | None

    def at_setpoints(self, targets: Floats) -> ArmState:
        """Return this state with the joints where they were told to be, if they are near.

        A motion that began where the arm sags to would sag further with every motion.
        """
        near = np.abs(targets - self.joints) <= SAG_RAD
        return ArmState(np.where(near, targets, self.joints), self.opening)


@dataclass(frozen=True)
class Arm:
    """One arm of a body.

    Attributes:
        chain: its kinematics.
        maps: of the chain's joints, in their order.
        jaw: of its gripper.
        speeds: the body's speed limit by action key, in its unit a second; motions are planned within it.
    """

    chain: Chain
    maps: tuple[JointMap, ...]
    jaw: JawMap | None
    speeds: Mapping[str, float] = field(default_factory=dict)
    bounds: Bounds = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.chain.joints)
        speeds = [
            min(
                JOINT_SPEED_RAD_S if joint.turns else SLIDE_SPEED_M_S,
                self.speeds.get(each.commanded, math.inf) / abs(each.factor),
            )
            for joint, each in zip(self.chain.joints, self.maps, strict=True)
        ]
        bounds = Bounds(np.array(speeds), np.full(count, ACCELERATION_RAD_S2))
        object.__setattr__(self, "bounds", bounds)

    @classmethod
    def of(cls, chain: Chain) -> Arm:
        """Return the arm of a body whose numbers are the model's own."""
        maps = _maps(chain)
        gripper = chain.gripper
        if gripper is None:
            return cls(chain, maps, None)
        seen = (gripper.joint.low, gripper.joint.high)
        return cls(chain, maps, JawMap(gripper.joint.name, gripper.joint.key, seen, (gripper.closed, gripper.opened)))

    def whole(self) -> Arm:
        """Return this arm with every actuated joint of its model."""
        chain = self.chain.whole()
        if chain is self.chain:
            return self
        return replace(self, chain=chain, maps=(*self.maps, *_maps(chain)[len(self.maps) :]))

    @property
    def parts(self) -> ArmParts:
        """Return what there is of an arm."""
        movable = any(not joint.refusal for joint in self.whole().joints)
        return ArmParts(joints=movable, model=True, tip=self.chain.leads_tip, jaws=self.jaw is not None)

    @property
    def joints(self) -> Sequence[ArmJoint]:
        """Joints of the chain, in their order."""
        return self.chain.joints

    def state(self, observation: Mapping[str, float]) -> ArmState:
        """Return the arm's state in an observation of its body.

        Raises:
            ValidationError: the observation lacks one of the joints.
        """
        missing = [each.observed for each in self.maps if each.observed not in observation]
        if missing:
            raise ValidationError(f"the arm's {', '.join(missing)} could not be read.")
        joints = np.array([each.position(observation[each.observed]) for each in self.maps])
        jaw = self.jaw
        known = jaw is not None and jaw.observed in observation
        return ArmState(joints, jaw.opening(observation[jaw.observed]) if jaw is not None and known else None)

    def setpoints(self, targets: Mapping[str, float]) -> Floats:
        """Return the joints that a body was told; NaN where that is not known."""
        return np.array(
            [
                np.nan if joint.refusal else each.radians(targets.get(each.commanded, np.nan))
                for joint, each in zip(self.chain.joints, self.maps, strict=True)
            ]
        )

    def action(self, joints: Floats) -> Action:
        """Return the targets of joint positions (rad), of the joints that take positions."""
        return {
            each.commanded: each.value(float(at))
            for joint, each, at in zip(self.chain.joints, self.maps, joints, strict=True)
            if not joint.refusal
        }

    def grip(self, opening: float) -> Action:
        """Return the target of a gripper's opening; nothing without a gripper."""
        return {} if self.jaw is None else {self.jaw.commanded: self.jaw.command(opening)}

    def jaw_radians(self, opening: float | None) -> float | None:
        """Return the position of the gripper's joint for an opening."""
        gripper = self.chain.gripper
        if gripper is None or opening is None:
            return None
        return gripper.joint.low + (gripper.joint.high - gripper.joint.low) * min(max(opening, 0.0), 1.0)

    def holding(self, state: ArmState, opening: float) -> bool | None:
        """Return True where something keeps still jaws from their ``opening``.

        None without a gripper.
        """
        return None if state.opening is None else state.opening > opening + GRIP_MARGIN

    def reached(self, state: ArmState | None, goal: Floats | None, wanted: Mapping[str, float]) -> dict[str, Any]:
        """Return ``reached``, the pose of the tip and the opening, and ``error_mm``.

        Args:
            state: what was observed last, None for nothing.
            goal: where the tip was to be (m), None for nowhere.
            wanted: where joints were to be, by name; the tip alone is measured.
        """
        if state is None:
            return {"reached": None, "error_mm": None}
        pose = self.chain.forward(state.joints)
        x, y, z = (round(float(v), 5) for v in pose.position)
        reached = {"x": x, "y": y, "z": z, "approach": round(pose.approach_deg, 2)}
        if state.opening is not None:
            reached["gripper"] = round(state.opening, 4)
        if goal is None:
            return {"reached": reached, "error_mm": None}
        offset = pose.position - goal
        return {"reached": reached, "error_mm": round(1000 * float(offset @ offset) ** 0.5, 2)}


def _maps(chain: Chain) -> tuple[JointMap, ...]:
    return tuple(JointMap(joint.name, joint.key, joint.factor, joint.offset, modelled=True) for joint in chain.joints)
