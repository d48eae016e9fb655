"""Where one robot's joints, actuators, cameras and sites are in the compiled model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from strands_robots.simulation.engine import mujoco

UNBOUNDED = float("inf")


@dataclass(frozen=True, slots=True)
class Actuator:
    """One command: its key in actions, its place in ``ctrl``, its range, and whether it is a position servo."""

    key: str
    index: int
    low: float
    high: float
    servo: bool

    def clamp(self, value: float) -> float:
        return min(max(value, self.low), self.high)


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint with a single coordinate: its place in ``qpos`` and ``qvel``, and its range (rad or m)."""

    key: str
    qpos: int
    qvel: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class RobotParts:
    """Everything of one robot in the model. ``base`` is the ``qpos`` address of its free joint, or None."""

    name: str
    model: str
    joints: dict[str, Joint]
    actuators: dict[str, Actuator]
    cameras: tuple[str, ...]
    tip: str
    root: str
    base: int | None

    @property
    def joint_keys(self) -> tuple[str, ...]:
        return tuple(self.joints)


def map_robot(model: Any, name: str, label: str) -> RobotParts:
    """Find everything whose name starts with ``name`` and a slash."""
    prefix = f"{name}/"
    joints: dict[str, Joint] = {}
    base: int | None = None
    joint_names: dict[int, str] = {}
    for index in range(model.njnt):
        full = model.joint(index).name
        if not full.startswith(prefix):
            continue
        kind = int(model.jnt_type[index])
        address = int(model.jnt_qposadr[index])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            base = address if base is None else base
            continue
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            continue
        key = full[len(prefix) :] or f"joint_{len(joints)}"
        low, high = model.jnt_range[index] if model.jnt_limited[index] else (-UNBOUNDED, UNBOUNDED)
        joints[key] = Joint(key, address, int(model.jnt_dofadr[index]), float(low), float(high))
        joint_names[index] = key
    actuators: dict[str, Actuator] = {}
    for index in range(model.nu):
        full = model.actuator(index).name
        target = int(model.actuator_trnid[index][0])
        on_joint = int(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_JOINT and target in joint_names
        if not full.startswith(prefix):
            continue
        key = full[len(prefix) :] or (joint_names[target] if on_joint else f"actuator_{len(actuators)}")
        low, high = model.actuator_ctrlrange[index] if model.actuator_ctrllimited[index] else (-UNBOUNDED, UNBOUNDED)
        # MuJoCo computes an inherited range, which leaves 2.0 as 2.0000000000000004.
        bounds = round(float(low), 12), round(float(high), 12)
        actuators[key] = Actuator(key, index, *bounds, is_servo(model, index))
    cameras = tuple(n for n in (model.camera(i).name for i in range(model.ncam)) if n.startswith(prefix))
    return RobotParts(name, label, joints, actuators, cameras, _tip(model, prefix), _root(model, prefix), base)


def is_servo(model: Any, index: int) -> bool:
    """True when the actuator is a position servo: its bias pulls back in proportion to its length."""
    return bool(model.actuator_biasprm[index][1] < 0.0)


def _root(model: Any, prefix: str) -> str:
    """The robot's first body."""
    return next((n for n in (str(model.body(i).name) for i in range(model.nbody)) if n.startswith(prefix)), "world")


def _tip(model: Any, prefix: str) -> str:
    """The site that stands for the robot's hand: the one called gripper_tip, else its last, else none."""
    sites = [n for n in (str(model.site(i).name) for i in range(model.nsite)) if n.startswith(prefix)]
    named = [n for n in sites if n.endswith("gripper_tip")]
    return (named or sites[-1:] or [""])[0]
