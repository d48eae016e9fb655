"""What stands in the world, and the MuJoCo model that is compiled from it.

A :class:`Plan` lists robots and objects; :func:`compile_stage` turns one into a :class:`Stage`, which never changes
afterwards: adding or removing something makes a new plan and a new stage. Inside the model a robot's parts carry its
name and a slash in front (``left/elbow_flex``); outside, each robot's keys are without it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.simulation import backdrop
from strands_robots.simulation.catalog import ModelSource
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.parts import Actuator, RobotParts, is_servo, map_robot
from strands_robots.utils import ValidationError

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RobotPlan:
    """One robot: ``position`` in metres, ``yaw`` in radians."""

    name: str
    source: ModelSource
    position: Triple = (0.0, 0.0, 0.0)
    yaw: float = 0.0


@dataclass(frozen=True, slots=True)
class ObjectPlan:
    """One object of primitive shape: sizes in metres, mass in kilograms, colour from 0 to 1."""

    name: str
    shape: str
    size: Triple
    position: Triple
    color: tuple[float, float, float, float]
    mass: float
    fixed: bool


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything in the world; ``timestep`` in seconds, ``gravity`` in m/s² along z."""

    timestep: float = 0.002
    gravity: float = -9.81
    robots: tuple[RobotPlan, ...] = ()
    objects: tuple[ObjectPlan, ...] = ()

    def with_robot(self, robot: RobotPlan) -> Plan:
        return replace(self, robots=(*self.robots, robot))

    def without_robot(self, name: str) -> Plan:
        return replace(self, robots=tuple(r for r in self.robots if r.name != name))

    def with_object(self, item: ObjectPlan) -> Plan:
        return replace(self, objects=(*self.objects, item))

    def without_object(self, name: str) -> Plan:
        return replace(self, objects=tuple(o for o in self.objects if o.name != name))


@dataclass(frozen=True, slots=True)
class Stage:
    """A compiled plan: the model, where each robot's numbers are in it, and the state it starts from."""

    plan: Plan
    model: Any
    robots: dict[str, RobotParts]
    start_qpos: Floats
    start_ctrl: Floats
    actuators: tuple[Actuator, ...] = field(default_factory=tuple)


_SHAPES = {"box": "BOX", "sphere": "SPHERE", "cylinder": "CYLINDER", "capsule": "CAPSULE"}
SHAPES = tuple(_SHAPES)


def compile_stage(plan: Plan) -> Stage:
    """Build and compile ``plan``. Raises :class:`ValidationError` naming the robot whose model does not fit."""
    spec = mujoco.MjSpec()
    spec.modelname = "world"
    _govern(spec, plan)
    homes: dict[str, Floats] = {}
    controls: dict[str, float] = {}
    if hasattr(mujoco, "mjtConflict"):
        # Solver options that only a robot's file sets are taken over; timestep, gravity and integrator are the world's.
        spec.compiler.conflict = mujoco.mjtConflict.mjCONFLICT_MERGE
    own_floor = own_lights = True
    for robot in plan.robots:
        child = robot.source.load()
        _govern(child, plan)
        own_floor = own_floor and not any(g.type == mujoco.mjtGeom.mjGEOM_PLANE for g in child.worldbody.geoms)
        own_lights = own_lights and not child.lights
        home, control = _attach(spec, robot, child)
        homes.update(home)
        controls.update(control)
    for item in plan.objects:
        _place(spec, item)
    backdrop.dress(spec, floor=own_floor, lights=own_lights)
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as exc:
        raise ValidationError(f"the world does not compile: {' '.join(str(exc).split())[:300]}") from exc
    model.opt.timestep = plan.timestep
    robots = {robot.name: map_robot(model, robot.name, robot.source.label) for robot in plan.robots}
    qpos, ctrl = _start(model, homes, controls)
    actuators = tuple(sorted((a for parts in robots.values() for a in parts.actuators.values()), key=lambda a: a.index))
    return Stage(plan, model, robots, qpos, ctrl, actuators)


def _govern(spec: Any, plan: Plan) -> None:
    """The options that the world decides, for itself and for every model in it."""
    spec.option.timestep = plan.timestep
    spec.option.gravity = [0, 0, plan.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _attach(spec: Any, robot: RobotPlan, child: Any) -> tuple[dict[str, Floats], dict[str, float]]:
    """Put ``child`` into ``spec``; its home pose and controls come back by their prefixed names."""
    try:
        if not child.actuators:
            _motorise(child)
        alone = robot.source.load() if child.keys else None
        home, control = ({}, {}) if alone is None else _home(alone.compile(), f"{robot.name}/")
        for key in list(child.keys):
            child.delete(key)
        frame = spec.worldbody.add_frame(
            pos=list(robot.position), quat=[float(np.cos(robot.yaw / 2)), 0, 0, float(np.sin(robot.yaw / 2))]
        )
        spec.attach(child, prefix=f"{robot.name}/", frame=frame)
    except (ValueError, mujoco.FatalError) as exc:
        why = " ".join(str(exc).split())[:300]
        raise ValidationError(f"model '{robot.source.label}' cannot stand in a world: {why}") from exc
    return home, control


def _motorise(child: Any) -> None:
    """Give a model without actuators (a URDF has none) a critically damped position servo at each joint."""
    for joint in child.joints:
        if joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE) or not joint.name:
            continue
        joint.armature = max(float(joint.armature), 0.01)
        servo = child.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=100.0, dampratio=1.0)
        limited = float(joint.range[0]) < float(joint.range[1])
        servo.ctrlrange = list(joint.range) if limited else [-np.pi, np.pi]
        servo.ctrllimited = True


def _home(model: Any, prefix: str) -> tuple[dict[str, Floats], dict[str, float]]:
    """The pose named home (else the first) of a model on its own, by prefixed joint and actuator name."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    index = max(key, 0)
    pose: dict[str, Floats] = {}
    for joint in range(model.njnt):
        name = model.joint(joint).name
        # A free joint starts where the robot was placed, not where its own model stood.
        if name and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            start = int(model.jnt_qposadr[joint])
            width = {1: 4}.get(int(model.jnt_type[joint]), 1)
            pose[prefix + name] = np.array(model.key_qpos[index][start : start + width])
    controls = {prefix + model.actuator(i).name: float(model.key_ctrl[index][i]) for i in range(model.nu)}
    return pose, controls


def _place(spec: Any, item: ObjectPlan) -> None:
    body = spec.worldbody.add_body(name=item.name, pos=list(item.position))
    if not item.fixed:
        body.add_freejoint(name=item.name)
    body.add_geom(
        name=item.name,
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{_SHAPES[item.shape]}"),
        size=list(item.size),
        rgba=list(item.color),
        mass=item.mass,
        friction=[1.0, 0.01, 0.001],
        condim=4,
    )


def _start(model: Any, homes: dict[str, Floats], controls: dict[str, float]) -> tuple[Floats, Floats]:
    data = mujoco.MjData(model)
    for name, values in homes.items():
        address = int(model.joint(name).qposadr[0])
        data.qpos[address : address + len(values)] = values
    mujoco.mj_forward(model, data)
    ctrl = np.zeros(model.nu)
    for index in range(model.nu):
        name = model.actuator(index).name
        wanted = controls.get(name)
        if wanted is None:
            # A servo without a given target starts by holding where it is.
            wanted = float(data.actuator_length[index]) if is_servo(model, index) else 0.0
        low, high = model.actuator_ctrlrange[index] if model.actuator_ctrllimited[index] else (-np.inf, np.inf)
        ctrl[index] = min(max(wanted, low), high)
    return np.array(data.qpos), ctrl
