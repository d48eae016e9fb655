"""One robot of a simulated world: observations, actions, base, objects, torque."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from strands_robots.kinematics import ArmParts
from strands_robots.kinematics.arm import Arm
from strands_robots.kinematics.chain import Chain, Floats
from strands_robots.kinematics.objects import SeenObject
from strands_robots.policies.base import Observation, checked_speeds
from strands_robots.policies.settling import Settling, checked_rest_pose
from strands_robots.policies.task_engine import TaskEngine
from strands_robots.safety.gate import Permit
from strands_robots.safety.stopping import checked_level
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.model import PICTURE, Actuator, RobotParts, load_named
from strands_robots.simulation.physics import Physics, Snapshot, WorldClock
from strands_robots.simulation.scene import ModelSource, SceneObject
from strands_robots.utils import ValidationError, mapping, number, w_positive, yaw_of


def targets_of(snapshot: Snapshot, base: dict[str, Any]) -> list[SeenObject]:
    """Return the objects in the frame of ``base``, a ``RobotBody.base_pose``."""
    data = snapshot.data()
    cosine, sine = np.cos(base["theta"]), np.sin(base["theta"])
    into_base = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    origin = np.array([base["x"], base["y"], base["z"]])
    found = []
    for item in snapshot.compiled.scene.objects:
        body = data.body(item.name)
        position = into_base @ (body.xpos - origin)
        yaw = yaw_of([float(v) for v in body.xquat]) - float(base["theta"])
        yaw = float((yaw + np.pi) % (2 * np.pi) - np.pi)
        found.append(SeenObject(item.name, position, yaw, _extents(item), item.shape != "box", item.fixed))
    return found


def _extents(item: SceneObject) -> Floats:
    """Return the extents of an upright object along its own axes (m)."""
    x, y, z = item.size
    if item.shape == "box":
        return 2 * np.array([x, y, z])
    half = {"sphere": x, "cylinder": y, "capsule": x + y}[item.shape]
    return 2 * np.array([x, x, half])


WORLD_CAMERAS = ("front", "table")
"""Cameras of the world that every robot observes with, besides its own."""

Draw = Callable[[Snapshot, str], Any]
"""Draws the picture of a camera, by its full name."""

PLANAR = 2
"""Sliding joints of one body that make it a mobile base; one alone is a rail, or an arm's first joint."""


class RobotBody:
    """One robot by joint and actuator name, without its prefix in the world.

    A rollout or a teleoperation drives it; ``draw`` makes the pictures of its observations. Every
    method raises :class:`ValidationError` once the robot was removed.
    """

    def __init__(
        self,
        name: str,
        physics: Physics,
        clock: WorldClock,
        speed_limit: float | Mapping[str, float] | None = None,
        draw: Draw | None = None,
    ) -> None:
        self.name = name
        self._draw = draw
        self._physics = physics
        self._clock = clock
        self._speed_limit = speed_limit
        self.on_motion: Callable[[], None] = lambda: None
        """Called before each action."""

    @property
    def parts(self) -> RobotParts:
        """The robot's places in the present model."""
        return self._present()[1]

    @property
    def action_features(self) -> dict[str, Any]:
        """Type of each action key, as LeRobot robots give it."""
        return dict.fromkeys(self.parts.actuators, float)

    @property
    def observation_features(self) -> dict[str, Any]:
        """Type of each observation key."""
        return {**dict.fromkeys(self.get_joints(), float), **dict.fromkeys(self.cameras, PICTURE)}

    @property
    def cameras(self) -> dict[str, str]:
        """Full name of each camera of an observation: its own, and two of the world."""
        if self._draw is None:
            return {}
        _, parts = self._present()
        own = {name.removeprefix(f"{self.name}/"): name for name in parts.cameras}
        return {**{name: name for name in WORLD_CAMERAS}, **own}

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest command of each action key; infinite without a limit."""
        return {key: (a.low, a.high) for key, a in self.parts.actuators.items()}

    @property
    def targets(self) -> dict[str, float]:
        """Present setpoint of each action key."""
        setpoints = self._physics.setpoints
        return {key: float(setpoints[actuator.index]) for key, actuator in self.parts.actuators.items()}

    @property
    def speeds(self) -> dict[str, float]:
        """Greatest speed of each position servo that was given one, in its unit a second."""
        if self._speed_limit is None:
            return {}
        return checked_speeds(self._speed_limit, [key for key, each in self.parts.actuators.items() if each.servo])

    @property
    def arm(self) -> Arm:
        """The robot's arm, planned in the frame of its base. Raises without one."""
        made, speeds = arm_of(*self._source), self.speeds
        return replace(made, speeds=speeds) if speeds else made

    @property
    def arm_parts(self) -> ArmParts:
        """Parts of an arm that the robot has."""
        return _parts_of(*self._source)

    @property
    def _source(self) -> tuple[ModelSource, float, str]:
        scene = next(each for each in self._present()[0].compiled.scene.robots if each.name == self.name)
        return scene.source, scene.position[2], scene.tip

    @property
    def joint_units(self) -> dict[str, str]:
        """``radians`` or ``metres`` of each position servo commanded in its joint's unit."""
        snapshot, parts = self._present()
        units = {key: _unit(snapshot.compiled.model, actuator) for key, actuator in parts.actuators.items()}
        return {key: unit for key, unit in units.items() if unit}

    def clock(self) -> float:
        """Return the simulated time in seconds."""
        return self._physics.snapshot.time

    def get_joints(self) -> dict[str, float]:
        """Return joint positions (rad; m for a slide) and the pose of a free base."""
        snapshot, parts = self._present()
        return snapshot.observation(parts)

    def get_positions(self) -> dict[str, float]:
        """Return the command of each position servo that would keep it where it is."""
        snapshot, parts = self._present()
        lengths = snapshot.lengths
        servos = (each for each in parts.actuators.values() if each.servo)
        return {each.key: each.still(float(lengths[each.index])) for each in servos}

    def get_observation(self) -> Observation:
        """Return the joints, and 640 x 480 pictures of :attr:`cameras` of that moment.

        A picture is drawn when it is read, so that a loop that reads none costs no drawing.
        """
        snapshot, parts = self._present()
        draw = self._draw
        pictures = {} if draw is None else {key: partial(draw, snapshot, name) for key, name in self.cameras.items()}
        return Observation(snapshot.observation(parts), pictures)

    def send_action(self, action: Mapping[str, float], permit: Permit | None = None) -> dict[str, float]:
        """Set targets, clamped to the actuators' ranges, and return them.

        Raises:
            ValidationError: an unknown key, or a value that is no finite number; nothing was written.
            PermitVoidError: ``permit`` is void; nothing was written.
        """
        checked = {key: number(f"action[{key!r}]", value) for key, value in mapping("action", action).items()}
        if permit is None or permit.valid:
            self.on_motion()
        sent = self._physics.command(self.name, checked, permit)
        self._clock.commanded()
        return sent

    def hold(self, permit: Permit | None = None) -> None:
        """Freeze the robot, unless ``permit`` was revoked: then that halt froze it."""
        self._physics.hold(self.name, permit)

    def let_go(self, permit: Permit | None = None) -> None:
        """Switch the torque off until the next action, which begins where it is then.

        Raises:
            PermitVoidError: ``permit`` is void; nothing was changed.
        """
        self._physics.release(self.name, permit)
        self._clock.commanded()

    def running(self) -> AbstractContextManager[None]:
        """Return a context in which physics keeps real time."""
        return self._clock.running()

    def tip_position(self) -> tuple[float, float, float]:
        """Return the place of the gripper's tip, else of the base, in metres."""
        snapshot, parts = self._present()
        data = snapshot.data()
        x, y, z = data.site(parts.tip).xpos if parts.tip else data.body(parts.root).xpos
        return float(x), float(y), float(z)

    def base_pose(self) -> dict[str, Any]:
        """Return ``x``, ``y``, ``z`` (m), ``theta`` (yaw, rad), ``quat`` (w, x, y, z).

        The base of a mobile robot is its first body; any other stands where it was placed.
        """
        snapshot, parts = self._present()
        if _mobile(snapshot, parts):
            base = snapshot.data().body(parts.root)
            position, quat = [float(v) for v in base.xpos], [float(v) for v in base.xquat]
        else:
            scene = next(each for each in snapshot.compiled.scene.robots if each.name == self.name)
            position, quat = list(scene.position), [math.cos(scene.yaw / 2), 0.0, 0.0, math.sin(scene.yaw / 2)]
        x, y, z = position
        return {"x": x, "y": y, "z": z, "theta": yaw_of(quat), "quat": w_positive(quat)}

    def base_velocity(self) -> dict[str, list[float]] | None:
        """Return ``linear`` (m/s) and ``angular`` (rad/s) of a mobile base, else None.

        The axes are the base's own, x forwards and z up, as in the twist of ROS's ``nav_msgs/Odometry``.
        """
        snapshot, parts = self._present()
        if not _mobile(snapshot, parts):
            return None
        model, data = snapshot.compiled.model, snapshot.data()
        mujoco.mj_comVel(model, data)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(parts.root).id, velocity, 1)
        # MuJoCo writes the rotation first.
        return {"linear": [float(v) for v in velocity[3:]], "angular": [float(v) for v in velocity[:3]]}

    def _present(self) -> tuple[Snapshot, RobotParts]:
        snapshot = self._physics.snapshot
        parts = snapshot.compiled.robots.get(self.name)
        if parts is None:
            raise ValidationError(f"robot {self.name} is not in the world any more.")
        return snapshot, parts


@cache
def arm_of(source: ModelSource, height: float, tip: str = "") -> Arm:
    """Return the arm of a model whose base is ``height`` metres above the floor.

    Raises:
        ValidationError: the model has no arm.
    """
    return Arm.of(Chain(load_named(source), source.label, -height, tip))


@cache
def _parts_of(source: ModelSource, height: float, tip: str) -> ArmParts:
    try:
        return arm_of(source, height, tip).parts
    except ValidationError:
        return ArmParts()


def _mobile(snapshot: Snapshot, robot: RobotParts) -> bool:
    """Return True for a robot whose base is free, or slides in a plane."""
    if robot.base is not None:
        return True
    model = snapshot.compiled.model
    body = model.body(robot.root).id
    first = int(model.body_jntadr[body])
    joints = range(first, first + int(model.body_jntnum[body]))
    slides = [joint for joint in joints if int(model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_SLIDE]
    return len(slides) >= PLANAR


def _unit(model: Any, actuator: Actuator) -> str:
    """Return the unit of a position servo's command; empty unless it is the joint's."""
    index = actuator.index
    gain, bias = model.actuator_gainprm[index][0], model.actuator_biasprm[index][1]
    direct = model.actuator_gear[index][0] == 1.0 and math.isclose(gain, -bias)
    on_joint = int(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_JOINT
    if not (actuator.servo and direct and on_joint):
        return ""
    joint = int(model.jnt_type[int(model.actuator_trnid[index][0])])
    return {mujoco.mjtJoint.mjJNT_HINGE.value: "radians", mujoco.mjtJoint.mjJNT_SLIDE.value: "metres"}.get(joint, "")


class StopTorque:
    """Stop level of a world and, with ``settle``, the settling of each of its arms.

    Args:
        level: ``hold``, ``limp`` or ``settle``; None asks ``STRANDS_ESTOP_TORQUE``.
        rest_pose: targets of every robot by action key, or those by robot.
        tasks: of the world.

    Raises:
        ValidationError: no such level, or ``settle`` without a pose.
    """

    def __init__(self, level: object, rest_pose: object, tasks: TaskEngine) -> None:
        self._level = checked_level(level, rest_pose)
        self._pose = None if rest_pose is None else mapping("rest_pose", rest_pose)
        self._tasks = tasks

    def check(self, robots: Mapping[str, RobotParts]) -> None:
        """Raise :class:`ValidationError` unless the rest pose fits every robot."""
        for parts in robots.values():
            self._pose_of(parts)

    def fit(self, bodies: Mapping[str, RobotBody]) -> None:
        """Make the settling of each robot that joined, and forget that of others."""
        tasks = self._tasks
        settlings = {name: each for name, each in tasks.settlings.by_body.items() if name in bodies}
        for name, body in bodies.items():
            pose = self._pose_of(body.parts)
            if self._level == "settle" and pose and name not in settlings:
                ranges = {key: body.bounds[key] for key in pose}
                settling = Settling(body, tasks.gate, pose, ranges, tasks.observers, clock=body.clock)
                settlings[name], body.on_motion = settling, settling.note_motion
        tasks.settlings.by_body = settlings

    def freeze(self, physics: Physics, clock: WorldClock) -> None:
        """Freeze every robot of a world, and let it go where the level says so."""
        physics.hold()
        if self._level == "limp":
            physics.release()
            clock.commanded()

    def freeze_one(self, body: RobotBody) -> None:
        """Freeze one robot for good, also one that settles, or let it go."""
        settling = self._tasks.settlings.by_body.get(body.name)
        if settling is not None:
            settling.give_up()
            # It has stopped: the next halt finds it at rest.
            settling.take()
        body.hold()
        if self._level == "limp":
            body.let_go()

    def _pose_of(self, parts: RobotParts) -> dict[str, float]:
        """Return the checked rest pose of a robot; empty for none, or without servos."""
        servos = {key: (each.low, each.high) for key, each in parts.actuators.items() if each.servo}
        if self._pose is None or not servos:
            return {}
        pose: object = self._pose
        if any(isinstance(each, Mapping) for each in self._pose.values()):
            if parts.name not in self._pose:
                raise ValidationError(f"rest_pose must have a pose of {parts.name}; it has {', '.join(self._pose)}.")
            pose = self._pose[parts.name]
        return dict(checked_rest_pose(pose, servos))
