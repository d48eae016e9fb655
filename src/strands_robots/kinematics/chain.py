"""An arm of an MJCF model: joints, gripper, tip, and forward kinematics.

The base frame is the frame of the arm's own file: x forward, y left, z up, in metres. Angles of this package are
radians of the model. A :class:`Chain` never changes and holds no MuJoCo data, so threads may share it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from strands_robots.utils import ValidationError

Floats = NDArray[np.float64]

MODELS = Path(__file__).parents[1] / "models"

TABLE = "table"
"""Name of the plane on which the arm stands, in refusals; added to a model without one."""

ARM_JOINTS_MIN = 3

_AXIAL_M = 1e-3
"""Greatest distance of the tip from the axis of the last joint that makes this joint a roll."""

_HINGE, _SLIDE, _FREE = (
    mujoco.mjtJoint.mjJNT_HINGE.value,
    mujoco.mjtJoint.mjJNT_SLIDE.value,
    mujoco.mjtJoint.mjJNT_FREE.value,
)


@dataclass(frozen=True, slots=True)
class ArmJoint:
    """One joint: action key, places in ``qpos`` and ``qvel``, range (rad or m)."""

    name: str
    key: str
    qpos: int
    dof: int
    low: float
    high: float
    turns: bool


@dataclass(frozen=True, slots=True)
class Gripper:
    """The gripper: one joint, and its action range from ``closed`` to ``opened``.

    Attributes:
        joint: what is measured; its ``low`` is closed.
        closed: command of the closed gripper, in the actuator's unit.
        opened: command of the open gripper.
        closing: direction in which it closes on the tip, in the frame of the tip's site.
        pad_m: distance of the jaw that stands still from the tip; 0 where both move.
    """

    joint: ArmJoint
    closed: float
    opened: float
    closing: Floats
    pad_m: float


@dataclass(frozen=True, slots=True)
class TipPose:
    """Pose of the tip in the base frame: metres, direction, rotation by columns."""

    position: Floats
    approach: Floats
    rotation: Floats

    @property
    def approach_deg(self) -> float:
        """Degrees of the approach direction below the horizontal."""
        return float(np.degrees(np.arcsin(np.clip(-self.approach[2], -1.0, 1.0))))


class Chain:
    """The arm of one model.

    Args:
        spec: the arm alone, with its base where the base frame is; it is changed.
        label: what the model is called in refusals.
        table_z: height of the table in the base frame, metres; None for none.

    Raises:
        ValidationError: the model has no arm: no site at a tip, or fewer than three joints between base and tip.
    """

    def __init__(self, spec: Any, label: str, table_z: float | None = 0.0) -> None:
        has_plane = any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms)
        if table_z is not None and not has_plane:
            spec.worldbody.add_geom(
                name=TABLE, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.05], pos=[0, 0, table_z]
            )
        try:
            self.model = model = spec.compile()
        except (ValueError, mujoco.FatalError) as exc:
            raise ValidationError(f"model {label} does not compile: {' '.join(str(exc).split())[:300]}") from exc
        self.label = label
        self.table_z = 0.0 if table_z is None else table_z
        name = tip_site(model)
        if not name:
            raise ValidationError(f"{label} has no site at its tip, so it cannot be moved to a point.")
        self.site = int(model.site(name).id)
        self.joints = _joints_between(model, int(model.site_bodyid[self.site]), label)
        self._home = _home(model)
        data = self.data(self.rest)
        self.axis, self.roll = self._approach(data)
        self.gripper: Gripper | None = None
        self.gripper = self._gripper(data)

    @property
    def lows(self) -> Floats:
        """Lowest position of each joint."""
        return np.array([joint.low for joint in self.joints])

    @property
    def highs(self) -> Floats:
        """Highest position of each joint."""
        return np.array([joint.high for joint in self.joints])

    @property
    def rest(self) -> Floats:
        """Joint positions of the model's home, or of its zero within the limits."""
        home: Floats = np.clip([self._home[joint.qpos] for joint in self.joints], self.lows, self.highs)
        return home

    @property
    def shoulder(self) -> Floats:
        """Place of the first joint (m); an approach points away from it."""
        index = int(self.model.joint(self.joints[0].name).id)
        anchor: Floats = self.data(self.rest).xanchor[index].copy()
        return anchor

    @property
    def movable(self) -> NDArray[np.intp]:
        """Indices of the joints that place the tip: all but a roll."""
        return np.array([i for i in range(len(self.joints)) if i != self.roll])

    def limited(self, ranges: Mapping[str, tuple[float, float]]) -> Chain:
        """Return this chain with joints narrowed to ``ranges``, by name (rad or m)."""
        narrowed = copy.copy(self)
        narrowed.joints = tuple(_narrowed(joint, ranges) for joint in self.joints)
        return narrowed

    def data(self, joints: Floats, gripper: float | None = None) -> Any:
        """Return fresh MuJoCo data in a pose, with kinematics computed."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self._home
        self.put(data, joints, gripper)
        return data

    def put(self, data: Any, joints: Floats, gripper: float | None = None) -> None:
        """Put ``data`` into a pose and compute its kinematics."""
        for joint, value in zip(self.joints, joints, strict=True):
            data.qpos[joint.qpos] = value
        if gripper is not None and self.gripper is not None:
            data.qpos[self.gripper.joint.qpos] = gripper
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)

    def tip(self, data: Any) -> TipPose:
        """Return the pose of the tip in ``data``."""
        rotation = data.site_xmat[self.site].reshape(3, 3).copy()
        return TipPose(data.site_xpos[self.site].copy(), rotation @ self.axis, rotation)

    def forward(self, joints: Floats) -> TipPose:
        """Return the pose of the tip for joint positions."""
        return self.tip(self.data(joints))

    def _approach(self, data: Any) -> tuple[Floats, int | None]:
        """Return the approach in the site's frame, and the index of a roll joint.

        It is the axis of the last joint, from there to the tip; where this joint does not point at the tip, the
        direction from it to the tip.
        """
        last = self.joints[-1]
        index = int(self.model.joint(last.name).id)
        axis, anchor = data.xaxis[index], data.xanchor[index]
        towards = data.site_xpos[self.site] - anchor
        along = float(axis @ towards)
        rotation = data.site_xmat[self.site].reshape(3, 3)
        if not last.turns or abs(along) < 0.5 * float(np.linalg.norm(towards)):
            length = float(np.linalg.norm(towards))
            direction = towards / length if length > 1e-6 else axis
            return rotation.T @ direction, None
        beside = float(np.linalg.norm(towards - along * axis))
        return rotation.T @ (axis * np.sign(along)), len(self.joints) - 1 if beside < _AXIAL_M else None

    def _gripper(self, data: Any) -> Gripper | None:
        model, own = self.model, {joint.name for joint in self.joints}
        hand = int(model.jnt_bodyid[model.joint(self.joints[-1].name).id])
        fingers = [
            index
            for index in range(model.njnt)
            if model.joint(index).name not in own
            and int(model.jnt_type[index]) in (_HINGE, _SLIDE)
            and hand in _ancestors(model, int(model.jnt_bodyid[index]))
        ]
        if not fingers:
            return None
        joint = _arm_joint(model, fingers[0])
        actuator = _actuator(model, fingers[0])
        free = [i for i in range(model.nu) if model.actuator(i).name not in {each.key for each in self.joints}]
        if actuator is None and len(free) == 1:
            actuator = free[0]
        closed, opened = joint.low, joint.high
        if actuator is not None:
            joint = replace(joint, key=str(model.actuator(actuator).name) or joint.name)
            if model.actuator_ctrllimited[actuator]:
                closed, opened = (float(v) for v in model.actuator_ctrlrange[actuator])
        tip, rotation = data.site_xpos[self.site], data.site_xmat[self.site].reshape(3, 3)
        axis = data.xaxis[fingers[0]]
        # Closing is towards the lower end of the joint.
        closing = -axis if not joint.turns else -np.cross(axis, tip - data.xanchor[fingers[0]])
        approach = rotation @ self.axis
        closing = closing - approach * float(approach @ closing)
        length = float(np.linalg.norm(closing))
        if length < 1e-9:
            return None
        closing /= length
        pad = 0.0
        if len(fingers) == 1:
            # Open, so that the ray meets the jaw that stands still.
            data.qpos[joint.qpos] = joint.high
            mujoco.mj_kinematics(model, data)
            hit = np.zeros(1, dtype=np.int32)
            reach = float(mujoco.mj_ray(model, data, tip, closing, None, 1, -1, hit))
            pad = reach if 0 < reach < 0.05 else 0.0
        return Gripper(joint, closed, opened, rotation.T @ closing, pad)


def tip_site(model: Any, prefix: str = "") -> str:
    """Return the site of the hand: gripper_tip, else the last one, else none."""
    sites = [name for name in (str(model.site(i).name) for i in range(model.nsite)) if name.startswith(prefix)]
    named = [name for name in sites if name.endswith("gripper_tip")]
    return (named or sites[-1:] or [""])[0]


@cache
def built_in(name: str) -> Chain:
    """Return the chain of a model that comes with the package: so100 or so101."""
    return Chain(mujoco.MjSpec.from_file(str(MODELS / f"{name}.xml")), name)


def _joints_between(model: Any, body: int, label: str) -> tuple[ArmJoint, ...]:
    found: list[ArmJoint] = []
    while body > 0:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for index in reversed(range(first, first + count)):
            kind = int(model.jnt_type[index])
            if kind == _FREE:
                break
            if kind not in (_HINGE, _SLIDE):
                raise ValidationError(
                    f"{label} has a joint that is neither hinge nor slide; its arm cannot be planned."
                )
            found.insert(0, _arm_joint(model, index))
        body = int(model.body_parentid[body])
    if len(found) < ARM_JOINTS_MIN:
        raise ValidationError(f"{label} has no arm: {len(found)} joints lead to its tip.")
    return tuple(found)


def _arm_joint(model: Any, index: int) -> ArmJoint:
    name = str(model.joint(index).name)
    actuator = _actuator(model, index)
    key = name if actuator is None else str(model.actuator(actuator).name) or name
    turns = int(model.jnt_type[index]) == _HINGE
    low, high = model.jnt_range[index] if model.jnt_limited[index] else (-np.pi, np.pi) if turns else (-1.0, 1.0)
    if actuator is not None and model.actuator_ctrllimited[actuator]:
        low, high = max(low, model.actuator_ctrlrange[actuator][0]), min(high, model.actuator_ctrlrange[actuator][1])
    address, dof = int(model.jnt_qposadr[index]), int(model.jnt_dofadr[index])
    return ArmJoint(name, key, address, dof, float(low), float(high), turns)


def _actuator(model: Any, joint: int) -> int | None:
    on_joint = mujoco.mjtTrn.mjTRN_JOINT.value
    return next(
        (
            index
            for index in range(model.nu)
            if int(model.actuator_trntype[index]) == on_joint and int(model.actuator_trnid[index][0]) == joint
        ),
        None,
    )


def _ancestors(model: Any, body: int) -> set[int]:
    found = set()
    while body > 0:
        found.add(body)
        body = int(model.body_parentid[body])
    return found


def _home(model: Any) -> Floats:
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    return np.array(model.key_qpos[max(key, 0)] if model.nkey else model.qpos0, dtype=np.float64)


def _narrowed(joint: ArmJoint, ranges: Mapping[str, tuple[float, float]]) -> ArmJoint:
    low, high = ranges.get(joint.name, (joint.low, joint.high))
    return replace(joint, low=max(joint.low, low), high=min(joint.high, high))
