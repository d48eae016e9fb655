"""Actuators of an MJCF model: which are position servos, and on which joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco

_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT.value, mujoco.mjtTrn.mjTRN_JOINTINPARENT.value)


@dataclass(frozen=True, slots=True)
class JointDrive:
    """One actuator on one joint.

    Attributes:
        actuator: its index, None for one that the model does not have.
        factor: command of a position servo for one radian or metre of the joint.
        offset: its command for the joint's zero.
        kind: ``position servo``, or what else it is.
    """

    actuator: int | None
    factor: float
    offset: float
    kind: str

    @property
    def servo(self) -> bool:
        """True where a command is a position."""
        return self.kind == POSITION


POSITION = "position servo"


def is_servo(model: Any, index: int) -> bool:
    """Return True for a position servo: its bias pulls back with its length."""
    return actuator_kind(model, index) == POSITION


def servo_line(model: Any, index: int) -> tuple[float, float]:
    """Return offset and slope of the command by which a servo keeps its length.

    Its force is gain * command + bias[0] + bias[1] * length, and zero where it stands.
    """
    gain, (constant, pull) = float(model.actuator_gainprm[index][0]), model.actuator_biasprm[index][:2]
    return (-float(constant) / gain, -float(pull) / gain) if gain else (0.0, 1.0)


def actuator_kind(model: Any, index: int) -> str:
    """Return what an actuator's command is, by its dynamics, gain and bias."""
    dynamics, gain, bias = (
        int(each[index]) for each in (model.actuator_dyntype, model.actuator_gaintype, model.actuator_biastype)
    )
    if mujoco.mjtDyn.mjDYN_MUSCLE.value == dynamics or mujoco.mjtGain.mjGAIN_MUSCLE.value == gain:
        return "muscle"
    if int(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_BODY.value:
        return "adhesion"
    if dynamics == mujoco.mjtDyn.mjDYN_INTEGRATOR.value:
        return "velocity servo"
    if gain != mujoco.mjtGain.mjGAIN_FIXED.value or model.actuator_gainprm[index][0] == 0:
        return "general actuator"
    if bias == mujoco.mjtBias.mjBIAS_NONE.value:
        return "torque motor"
    pull, brake = (float(value) for value in model.actuator_biasprm[index][1:3])
    if bias == mujoco.mjtBias.mjBIAS_AFFINE.value and pull < 0:
        return POSITION
    return "velocity servo" if brake < 0 else "general actuator"


def drives(model: Any) -> dict[int, JointDrive]:
    """Return the actuator of each hinge or slide by the joint's index.

    A position servo precedes other actuators of its joint. An actuator of a tendon counts where that is of one joint.
    A model without actuators describes an arm that has its own: each joint counts as a position servo.
    """
    if not model.nu:
        single = (each for each in range(model.njnt) if int(model.jnt_type[each]) in (_HINGE, _SLIDE))
        return {joint: JointDrive(None, 1.0, 0.0, POSITION) for joint in single}
    found: dict[int, JointDrive] = {}
    for index in range(model.nu):
        joint, ratio = _joint(model, index)
        if joint < 0 or not ratio or int(model.jnt_type[joint]) not in (_HINGE, _SLIDE):
            continue
        offset, slope = servo_line(model, index)
        drive = JointDrive(index, slope * ratio, offset, actuator_kind(model, index))
        if joint not in found or (drive.servo and not found[joint].servo):
            found[joint] = drive
    return found


def _joint(model: Any, index: int) -> tuple[int, float]:
    """Return an actuator's joint, -1 for none, and its length per radian or metre."""
    kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index][0])
    gear = float(model.actuator_gear[index][0])
    if kind in _ON_JOINT:
        return target, gear
    if kind == mujoco.mjtTrn.mjTRN_TENDON.value and int(model.tendon_num[target]) == 1:
        wrap = int(model.tendon_adr[target])
        if int(model.wrap_type[wrap]) == mujoco.mjtWrap.mjWRAP_JOINT.value:
            return int(model.wrap_objid[wrap]), gear * float(model.wrap_prm[wrap])
    return -1, 0.0
