"""An arm of an MJCF model: joints, gripper, tip, and forward kinematics.

Obstacles are spare bodies of the chain's model. MuJoCo keeps the interpreter while it compiles a model, for tens of
milliseconds where that has meshes. This one is compiled once with the chain; each plan takes a copy of it in memory and
sets the sizes and places of its obstacles.

The base frame is the frame of the arm's own file: x forward, y left, z up, in metres. Angles of this package are
radians of the model. A :class:`Chain` never changes and holds no MuJoCo data, so threads may share it.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from strands_robots.kinematics.model_file import ARM_JOINTS_MIN, JointDrive, actuator_kind, drives, is_servo, mark_tip
from strands_robots.utils import ValidationError

SPARES = 32
"""Spare bodies of a model; more obstacles than that compile it anew."""

CONTACT_BITS = 0x7FFFFFFF
"""Contact bits that meet every geom which meets any other."""

_AWAY_M = 1000.0
"""Depth at which a spare body waits, where no ray or contact of the arm meets it."""

_SPARE = "spare obstacle"
_SPARE_HELD = "spare held object"
_SPARE_SIZE_M = 1e-3

BOX, CYLINDER, BALL = (
    mujoco.mjtGeom.mjGEOM_BOX.value,
    mujoco.mjtGeom.mjGEOM_CYLINDER.value,
    mujoco.mjtGeom.mjGEOM_SPHERE.value,
)


class Spares:
    """The model with spare bodies; threads may share it.

    Args:
        spec: the chain's description, compiled before; it is changed.
        tip: name of the site of the tip.
    """

    def __init__(self, spec: Any, tip: str) -> None:
        self._spec, self._count = spec, 0
        self._growing = threading.Lock()
        # What is only seen costs memory in every plan; fused bodies would lose their names.
        spec.compiler.discardvisual, spec.compiler.fusestatic = True, False
        site = next(each for each in spec.sites if each.name == tip)
        _add_spare(site.parent.add_body(name=_SPARE_HELD, pos=[0, 0, -_AWAY_M]))
        self._model = self._grown(SPARES)

    def model(self, count: int) -> Any:
        """Return a model of its own with room for so many obstacles."""
        with self._growing:
            if count > self._count:
                self._model = self._grown(count)
            return copy.copy(self._model)

    def _grown(self, count: int) -> Any:
        """Compile the model with more spare bodies."""
        for index in range(self._count, count):
            _add_spare(self._spec.worldbody.add_body(name=f"{_SPARE} {index}", pos=[0, 0, -_AWAY_M * (1 + index)]))
        self._count = count
        model = self._compiled()
        for body in (held_body(model), *(spare_body(model, index) for index in range(count))):
            _meets(model, body, bits=0)
        return model

    def _compiled(self) -> Any:
        try:
            return self._spec.compile()
        except ValueError:
            if not self._spec.compiler.discardvisual:
                raise
        # A body whose inertia MuJoCo infers from all of its geoms needs those that are only seen.
        self._spec.compiler.discardvisual = False
        return self._spec.compile()


def spare_body(model: Any, index: int) -> int:
    """Return the body of a spare obstacle."""
    return int(model.body(f"{_SPARE} {index}").id)


def held_body(model: Any) -> int:
    """Return the spare body that goes where the tip goes."""
    return int(model.body(_SPARE_HELD).id)


@dataclass(frozen=True, slots=True)
class ObstacleShape:
    """Shape and place of an obstacle.

    Attributes:
        kind: :data:`BOX`, :data:`CYLINDER` or :data:`BALL`.
        half: half extents along the body's axes (m).
        position: in the frame of the parent (m).
        quaternion: in that frame; w, x, y, z.
    """

    kind: int
    half: Floats
    position: Floats
    quaternion: Floats


def place_obstacle(model: Any, body: int, shape: ObstacleShape) -> None:
    """Make a spare body an obstacle of a model that nobody else uses."""
    geom = int(model.body_geomadr[body])
    x, y, z = (float(value) for value in shape.half)
    wide = max(x, y)
    shapes = {
        BOX: ((x, y, z), (x, y, z), np.linalg.norm((x, y, z))),
        CYLINDER: ((wide, z, 0.0), (wide, wide, z), np.hypot(wide, z)),
        BALL: ((wide, 0.0, 0.0), (wide, wide, wide), wide),
    }
    model.geom_type[geom] = shape.kind
    model.geom_size[geom], around, model.geom_rbound[geom] = shapes[shape.kind]
    model.body_pos[body], model.body_quat[body] = shape.position, shape.quaternion
    # The bounds by which MuJoCo rules contacts out early.
    model.geom_aabb[geom] = (0.0, 0.0, 0.0, *around)
    first = int(model.body_bvhadr[body])
    model.bvh_aabb[first : first + int(model.body_bvhnum[body])] = model.geom_aabb[geom]
    _meets(model, body, CONTACT_BITS)


def _add_spare(body: Any) -> None:
    body.add_geom(type=BOX, size=[_SPARE_SIZE_M] * 3, contype=CONTACT_BITS, conaffinity=CONTACT_BITS)


def _meets(model: Any, body: int, bits: int) -> None:
    geom = int(model.body_geomadr[body])
    model.geom_contype[geom] = model.geom_conaffinity[geom] = bits
    model.body_contype[body] = model.body_conaffinity[body] = bits


Floats = NDArray[np.float64]

MODELS = Path(__file__).parents[1] / "models"

TABLE = "table"
"""Name of the plane on which the arm stands, in refusals; added to a model without one."""

_AXIAL_M = 1e-3
"""Greatest distance of the tip from the axis of the last joint that makes this joint a roll."""

_HINGE, _SLIDE, _FREE = (
    mujoco.mjtJoint.mjJNT_HINGE.value,
    mujoco.mjtJoint.mjJNT_SLIDE.value,
    mujoco.mjtJoint.mjJNT_FREE.value,
)


@dataclass(frozen=True, slots=True)
class ArmJoint:
    """One joint: action key, places in ``qpos`` and ``qvel``, range (rad or m).

    Attributes:
        factor: command of its position servo for one radian or metre.
        offset: its command for the joint's zero.
        refusal: why it cannot be moved to a position; empty where it can.
    """

    name: str
    key: str
    qpos: int
    dof: int
    low: float
    high: float
    turns: bool
    factor: float = 1.0
    offset: float = 0.0
    refusal: str = ""


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
        tip: site or body that motions place; by default as :mod:`~strands_robots.kinematics.model_file` finds it.

    Raises:
        ValidationError: the model does not compile, or has no joint with an actuator.
    """

    def __init__(self, spec: Any, label: str, table_z: float | None = 0.0, tip: str = "") -> None:
        has_plane = any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.worldbody.geoms)
        if table_z is not None and not has_plane:
            # Without a name, which the model may have given to a part of its own.
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.05], pos=[0, 0, table_z])
        name = mark_tip(spec, tip)
        try:
            self.model = model = spec.compile()
        except (ValueError, mujoco.FatalError) as exc:
            raise _uncompiled(label, exc) from exc
        self.label = label
        self.table_z = 0.0 if table_z is None else table_z
        self._drives = drives(model)
        self.site = int(model.site(name).id) if name else -1
        self.joints = self._leading(int(model.site_bodyid[self.site])) if name else ()
        if not self.joints:
            raise ValidationError(f"{label} has no joint that could be moved to a position{_actuators(model)}.")
        self._models_body = True
        self.floats = bool((model.jnt_type == _FREE).any())
        try:
            self.spares = Spares(spec, name)
        except (ValueError, mujoco.FatalError) as exc:
            raise _uncompiled(label, exc) from exc
        self.objects: Mapping[int, str] = {}
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
        index = int(self.model.dof_jntid[self.joints[0].dof])
        anchor: Floats = self.data(self.rest).xanchor[index].copy()
        return anchor

    @property
    def movable(self) -> NDArray[np.intp]:
        """Indices of the joints that place the tip: all but a roll."""
        return np.array([i for i in range(len(self.joints)) if i != self.roll])

    def beside(self, objects: Mapping[int, str], model: Any) -> Chain:
        """Return this chain with a model of its spares, and the objects by body."""
        crowded = copy.copy(self)
        crowded.model, crowded.objects = model, objects
        return crowded

    def whole(self) -> Chain:
        """Return this chain with every actuated joint but the gripper's."""
        if not self._models_body:
            return self
        own = {joint.name for joint in self.joints} | ({self.gripper.joint.name} if self.gripper else set())
        others = [each for each in map(self._joint, sorted(self._drives)) if each.name not in own]
        if not others:
            return self
        wider = copy.copy(self)
        wider.joints = (*self.joints, *others)
        return wider

    @property
    def leads_tip(self) -> bool:
        """True where the tip can be moved to a point."""
        return len(self.joints) >= ARM_JOINTS_MIN and not any(joint.refusal for joint in self.joints)

    def require_arm(self) -> None:
        """Refuse an arm whose tip cannot be moved to a point."""
        refused = next((joint.refusal for joint in self.joints if joint.refusal), "")
        if refused:
            raise ValidationError(f"the tip of {self.label} cannot be moved to a point: {refused}.")
        if len(self.joints) < ARM_JOINTS_MIN:
            raise ValidationError(f"{self.label} has no arm: {len(self.joints)} joints lead to its tip.")

    def limited(self, ranges: Mapping[str, tuple[float, float]]) -> Chain:
        """Return this chain for a real arm, with narrower joints.

        ``ranges`` are by name (rad or m). The arm has servos of its own, and no joint but these.
        """
        narrowed = copy.copy(self)
        narrowed._models_body = False
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
        index = int(self.model.dof_jntid[last.dof])
        axis, anchor = data.xaxis[index], data.xanchor[index]
        towards = data.site_xpos[self.site] - anchor
        along = float(axis @ towards)
        rotation = data.site_xmat[self.site].reshape(3, 3)
        length = float(np.linalg.norm(towards))
        if not last.turns or length < 1e-6 or abs(along) < 0.5 * length:
            direction = towards / length if length > 1e-6 else axis
            return rotation.T @ direction, None
        beside = float(np.linalg.norm(towards - along * axis))
        return rotation.T @ (axis * np.sign(along)), len(self.joints) - 1 if beside < _AXIAL_M else None

    def _leading(self, body: int) -> tuple[ArmJoint, ...]:
        """Return the actuated joints between the base and a body."""
        model, found = self.model, []
        while body > 0:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            found += [index for index in reversed(range(first, first + count)) if index in self._drives]
            body = int(model.body_parentid[body])
        return tuple(self._joint(index) for index in reversed(found))

    def _joint(self, index: int) -> ArmJoint:
        model, drive = self.model, self._drives.get(index)
        name, turns = str(model.joint(index).name), int(model.jnt_type[index]) == _HINGE
        low, high = model.jnt_range[index] if model.jnt_limited[index] else (-np.pi, np.pi) if turns else (-1.0, 1.0)
        lowest, highest = _servo_range(model, drive)
        if max(low, lowest) < min(high, highest):
            low, high = max(low, lowest), min(high, highest)
        places = int(model.jnt_qposadr[index]), int(model.jnt_dofadr[index])
        if drive is None:
            return ArmJoint(name, name, *places, float(low), float(high), turns, refusal=f"{name} has no actuator")
        key = name if drive.actuator is None else str(model.actuator(drive.actuator).name) or name
        if drive.servo:
            return ArmJoint(name, key, *places, float(low), float(high), turns, drive.factor, drive.offset)
        refusal = f"the actuator {key} of {name} is a {drive.kind}, whose command is no position"
        return ArmJoint(name, key, *places, float(low), float(high), turns, refusal=refusal)

    def _gripping(self, finger: int) -> int | None:
        """Return the servo of a finger, or the only actuator beside the arm's."""
        model, drive = self.model, self._drives.get(finger)
        keys = {joint.key for joint in self.joints}
        free = [index for index in range(model.nu) if model.actuator(index).name not in keys]
        actuator = drive.actuator if drive is not None else free[0] if len(free) == 1 else None
        return actuator if actuator is not None and is_servo(model, actuator) else None

    def _gripper(self, data: Any) -> Gripper | None:
        model, own = self.model, {joint.name for joint in self.joints}
        hand = int(model.dof_bodyid[self.joints[-1].dof])
        fingers = [
            index
            for index in range(model.njnt)
            if model.joint(index).name not in own
            and int(model.jnt_type[index]) in (_HINGE, _SLIDE)
            and hand in _ancestors(model, int(model.jnt_bodyid[index]))
        ]
        if not fingers:
            return None
        joint, actuator = self._joint(fingers[0]), self._gripping(fingers[0])
        if actuator is None and model.nu:
            return None
        closed, opened = joint.low, joint.high
        if actuator is not None:
            joint = replace(joint, key=str(model.actuator(actuator).name) or joint.name, refusal="")
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


def _servo_range(model: Any, drive: JointDrive | None) -> tuple[float, float]:
    """Return the joint positions (rad or m) of the ends of a servo's commands."""
    if drive is None or drive.actuator is None or not drive.servo or not model.actuator_ctrllimited[drive.actuator]:
        return -np.inf, np.inf
    low, high = ((float(each) - drive.offset) / drive.factor for each in model.actuator_ctrlrange[drive.actuator])
    return min(low, high), max(low, high)


@cache
def built_in(name: str) -> Chain:
    """Return the chain of a model that comes with the package: so100 or so101."""
    return Chain(mujoco.MjSpec.from_file(str(MODELS / f"{name}.xml")), name)


def _actuators(model: Any) -> str:
    """Return a model's actuators by name, for a refusal."""
    kinds = [actuator_kind(model, index) for index in range(model.nu)]
    names = [f"{model.actuator(index).name} ({kind})" for index, kind in enumerate(kinds)]
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return f"; its actuators are {', '.join(names[:6])}{more}" if names else ", and no actuator"


def _ancestors(model: Any, body: int) -> set[int]:
    found = set()
    while body > 0:
        found.add(body)
        body = int(model.body_parentid[body])
    return found


def _uncompiled(label: str, exc: Exception) -> ValidationError:
    return ValidationError(f"model {label} does not compile: {' '.join(str(exc).split())[:300]}")


def _home(model: Any) -> Floats:
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    return np.array(model.key_qpos[max(key, 0)] if model.nkey else model.qpos0, dtype=np.float64)


def _narrowed(joint: ArmJoint, ranges: Mapping[str, tuple[float, float]]) -> ArmJoint:
    low, high = ranges.get(joint.name, (joint.low, joint.high))
    return replace(joint, low=max(joint.low, low), high=min(joint.high, high), refusal="")
