"""Where the base of a simulated robot is and how it moves, and the units in which its actuators are commanded."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from strands_robots.quaternions import w_positive, yaw_of
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.parts import RobotParts
from strands_robots.simulation.physics import Snapshot

PLANAR = 2
"""Sliding joints of one body that make it a base that moves about; one alone is a rail, or an arm's first joint."""


def moves_about(snapshot: Snapshot, robot: RobotParts) -> bool:
    """Whether the robot's base is free, or slides in a plane."""
    return robot.base is not None or _slides(snapshot.stage.model, robot) >= PLANAR


def base_pose(snapshot: Snapshot, robot: RobotParts) -> dict[str, Any]:
    """``x``, ``y``, ``z`` (m), ``theta`` (yaw, rad) and ``quat`` (w, x, y, z) of the base in the world.

    A base that moves about is its first body; one that does not stands where it was put.
    """
    if moves_about(snapshot, robot):
        data, body = _posed(snapshot), snapshot.stage.model.body(robot.root).id
        position, quat = [float(v) for v in data.xpos[body]], [float(v) for v in data.xquat[body]]
    else:
        plan = next(each for each in snapshot.stage.plan.robots if each.name == robot.name)
        position, quat = list(plan.position), [math.cos(plan.yaw / 2), 0.0, 0.0, math.sin(plan.yaw / 2)]
    x, y, z = position
    return {"x": x, "y": y, "z": z, "theta": yaw_of(quat), "quat": w_positive(quat)}


def base_velocity(snapshot: Snapshot, robot: RobotParts) -> dict[str, list[float]]:
    """``linear`` (m/s) and ``angular`` (rad/s) of a base that moves about, along its own axes: x forwards, z up.

    The axes are those of the twist in ROS's ``nav_msgs/Odometry``.
    """
    model, data = snapshot.stage.model, _posed(snapshot)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    found = np.zeros(6)
    kind = mujoco.mjtObj.mjOBJ_XBODY
    mujoco.mj_objectVelocity(model, data, kind, model.body(robot.root).id, found, 1)
    # MuJoCo writes the rotation first.
    return {"linear": [float(v) for v in found[3:]], "angular": [float(v) for v in found[:3]]}


def joint_units(snapshot: Snapshot, robot: RobotParts) -> dict[str, str]:
    """``radians`` or ``metres`` by action key, of the position servos that are commanded in their joint's own unit."""
    model = snapshot.stage.model
    units: dict[str, str] = {}
    for key, actuator in robot.actuators.items():
        index = actuator.index
        straight = model.actuator_gear[index][0] == 1.0 and math.isclose(
            model.actuator_gainprm[index][0], -model.actuator_biasprm[index][1]
        )
        on_joint = int(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_JOINT
        if not (actuator.servo and straight and on_joint):
            continue
        joint = int(model.jnt_type[int(model.actuator_trnid[index][0])])
        if joint == mujoco.mjtJoint.mjJNT_HINGE:
            units[key] = "radians"
        elif joint == mujoco.mjtJoint.mjJNT_SLIDE:
            units[key] = "metres"
    return units


def _posed(snapshot: Snapshot) -> Any:
    data = mujoco.MjData(snapshot.stage.model)
    data.qpos[:] = snapshot.qpos
    data.qvel[:] = snapshot.qvel
    mujoco.mj_kinematics(snapshot.stage.model, data)
    return data


def _slides(model: Any, robot: RobotParts) -> int:
    body = model.body(robot.root).id
    first = int(model.body_jntadr[body])
    joints = range(first, first + int(model.body_jntnum[body]))
    return sum(int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_SLIDE for joint in joints)
