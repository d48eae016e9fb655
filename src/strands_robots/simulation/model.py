"""The MuJoCo model compiled from a scene, and each robot's parts in it.

MuJoCo has one set of options for a whole world. What a file sets there is confined to the model's own parts, refused
by name, or left at the world's value, so that no model changes the physics of its neighbours.

A :class:`CompiledScene` never changes: adding or removing something makes a new scene, which is compiled anew. Inside
the model the names of a robot's parts start with its own name and a slash (``left/elbow_flex``); outside, its keys are
without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.kinematics.model_file import is_servo, mark_tip, servo_line
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.scene import ModelSource, Scene, SceneObject, SceneRobot
from strands_robots.utils import ValidationError, shown

_UNLIMITED = mujoco.mjtLimited.mjLIMITED_FALSE

_REFUSED_FLAGS = ("passive", "spring", "damper", "clampctrl", "filterparent", "actuation", "refsafe")
"""Parts of physics that a file may switch off, and that cannot be switched off for one model alone.

MuJoCo 3.3 has ``passive`` where later ones have ``spring`` and ``damper``."""

_EXACTNESS = (
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "sdf_iterations",
    "sdf_initpoints",
    "impratio",
    "cone",
)
"""Options of the solver of which the larger value is the more exact one."""

_LEVEL_M = 1e-6
"""Greatest height of a model's floor that is the floor of the world."""

_BUFFERS = ("memory", "njmax", "nconmax", "nstack")
"""Sizes of buffers: what is enough for a model alone is not beside others."""


def load_fitted(robot: SceneRobot, scene: Scene) -> Any:
    """Return the ``MjSpec`` of a robot's model, fit for the world of ``scene``.

    Raises:
        ValidationError: the file cannot be loaded, or needs what a shared world cannot give.
    """
    child = load_named(robot.source)
    try:
        _require_medium(child.option, scene)
        _confine_flags(child)
    except ValidationError as exc:
        raise ValidationError(f"model {shown(robot.source.label)} cannot share a world: {exc}") from exc
    for geom in filter(is_floor, child.worldbody.geoms):
        if abs(robot.position[2] + float(geom.pos[2])) < _LEVEL_M:
            _make_common(geom)
        else:
            _make_scenery(geom)
    return child


def load_named(source: ModelSource) -> Any:
    """Return the ``MjSpec`` of a model, every part with a name, and with actuators.

    Raises:
        ValidationError: the file cannot be loaded.
    """
    child = source.load()
    name_parts(child)
    if not child.actuators:
        _add_servos(child)
    return child


def set_options(world: Any, models: Sequence[Any], scene: Scene) -> None:
    """Give the world and every model in it the options of the world.

    A file may make the solver more exact, never less; the world decides everything else.
    """
    option = mujoco.MjSpec().option
    for name in _EXACTNESS:
        setattr(option, name, max(getattr(spec.option, name) for spec in (world, *models)))
    option.timestep = scene.timestep
    option.gravity = [0, 0, scene.gravity]
    option.density, option.viscosity = scene.density, scene.viscosity
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for spec in (world, *models):
        for name in (name for name in dir(option) if not name.startswith("_")):
            setattr(spec.option, name, getattr(option, name))
        for name in _BUFFERS:
            setattr(spec, name, -1)


def name_parts(child: Any) -> None:
    """Name unnamed actuators by their joint, other unnamed parts by number."""
    for kind, parts in (("body", child.bodies[1:]), ("joint", child.joints)):
        taken = {part.name for part in parts}
        for number, part in enumerate(parts):
            part.name = part.name or _free_name(f"{kind}_{number}", taken)
    taken = {actuator.name for actuator in child.actuators}
    for number, actuator in enumerate(child.actuators):
        if not actuator.name:
            on_joint = actuator.trntype in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
            actuator.name = _free_name(actuator.target if on_joint else f"actuator_{number}", taken)


def is_floor(geom: Any) -> bool:
    """Return True for a level plane that objects of the world stand on."""
    if geom.type != mujoco.mjtGeom.mjGEOM_PLANE or not (geom.contype & 1 or geom.conaffinity & 1):
        return False
    if geom.alt.type == mujoco.mjtOrientation.mjORIENTATION_ZAXIS:
        x, y, z = (float(v) for v in geom.alt.zaxis)
        return z > 0 and math.hypot(x, y) < 1e-6 * z
    _, x, y, _ = (float(v) for v in geom.quat)
    return bool(geom.alt.type == mujoco.mjtOrientation.mjORIENTATION_QUAT) and math.hypot(x, y) < 1e-6


def _free_name(wanted: str, taken: set[str]) -> str:
    name, number = wanted, 2
    while name in taken:
        name, number = f"{wanted}_{number}", number + 1
    taken.add(name)
    return name


def _add_servos(child: Any) -> None:
    """Add a critically damped position servo to each joint; a URDF has no actuators."""
    for joint in child.joints:
        if joint.type not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            continue
        joint.armature = max(float(joint.armature), 0.01)
        servo = child.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=100.0, dampratio=1.0)
        # A file may give a hinge's range in degrees; a command is in radians always.
        unit = math.pi / 180 if child.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
        low, high = (float(bound) * unit for bound in joint.range)
        servo.ctrlrange = [low, high] if low < high and joint.limited != _UNLIMITED else [-math.pi, math.pi]
        servo.ctrllimited = True


def _require_medium(option: Any, scene: Scene) -> None:
    """Refuse a medium that is not the world's, wind, and disabled actuators."""
    own = {"density": float(option.density), "viscosity": float(option.viscosity)}
    if any(own.values()) and own != {"density": scene.density, "viscosity": scene.viscosity}:
        wanted = ", ".join(f"{key}={value:g}" for key, value in own.items())
        raise ValidationError(
            f"its medium ({wanted}) would slow everything in it. Give the world that medium: Simulation({wanted})."
        )
    if any(float(v) for v in option.wind):
        raise ValidationError("its option wind would blow at everything in it.")
    if option.disableactuator:
        raise ValidationError("its option actuatorgroupdisable would disable actuators of other robots.")


def _confine_flags(child: Any) -> None:
    """Apply flags to the model's own parts, or refuse them.

    The flags that are not named here choose between ways to compute the same, or report more.
    """
    option, bits = child.option, mujoco.mjtDisableBit
    if option.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        raise ValidationError("its flag override would set every contact in it.")
    for name in _REFUSED_FLAGS:
        if option.disableflags & getattr(bits, f"mjDSBL_{name.upper()}", 0):
            raise ValidationError(f"its flag {name} would switch that off for everything in it.")
    confined: dict[Any, Callable[[Any], None]] = {
        bits.mjDSBL_CONTACT: _without_contacts,
        bits.mjDSBL_LIMIT: _without_limits,
        bits.mjDSBL_EQUALITY: _without_equalities,
        bits.mjDSBL_FRICTIONLOSS: _without_friction_loss,
        bits.mjDSBL_GRAVITY: _without_gravity,
    }
    for bit, confine in confined.items():
        constraint = bit != bits.mjDSBL_GRAVITY and option.disableflags & bits.mjDSBL_CONSTRAINT
        if option.disableflags & bit or constraint:
            confine(child)


def _without_contacts(child: Any) -> None:
    for geom in child.geoms:
        geom.contype = geom.conaffinity = 0
    for pair in list(child.pairs):
        child.delete(pair)


def _without_limits(child: Any) -> None:
    for part in (*child.joints, *child.tendons):
        part.limited = _UNLIMITED


def _without_equalities(child: Any) -> None:
    for equality in list(child.equalities):
        child.delete(equality)


def _without_friction_loss(child: Any) -> None:
    for part in (*child.joints, *child.tendons):
        part.frictionloss = 0.0


def _without_gravity(child: Any) -> None:
    for body in child.bodies[1:]:
        body.gravcomp = 1.0


def _make_common(floor: Any) -> None:
    """Give a floor, on which everything stands, the usual contact parameters."""
    usual = mujoco.MjSpec().worldbody.add_geom()
    for name in ("priority", "solmix", "solref", "solimp", "margin", "gap", "friction", "condim"):
        setattr(floor, name, getattr(usual, name))


def _make_scenery(floor: Any) -> None:
    """Take a floor that is not at the world's height out of contacts and pictures.

    It is not deleted, for pairs and sensors of the model may name it.
    """
    floor.contype = floor.conaffinity = 0
    floor.rgba = [0, 0, 0, 0]


Floats = NDArray[np.float64]

FURNISHED = Path(__file__).with_name("world.xml")
"""An empty world: sky, floor, lights and cameras."""

MAX_WIDTH, MAX_HEIGHT = 1920, 1440
"""Largest picture, in pixels: the size of the off-screen buffer."""

PICTURE = (480, 640, 3)
"""Shape of a picture in an observation."""

UNBOUNDED = float("inf")

SUNK_M = 0.003
"""Depth in a plane from which a body does not only rest on it, in metres."""


@dataclass(frozen=True, slots=True)
class Actuator:
    """One action key: index in ``ctrl``, range; ``servo`` marks a position servo.

    A servo keeps a length with the command ``offset + slope * length``.
    """

    key: str
    index: int
    low: float
    high: float
    servo: bool
    offset: float = 0.0
    slope: float = 1.0

    def still(self, length: float) -> float:
        """Return the command that keeps a position, or stops everything else."""
        return self.clamp(self.offset + self.slope * length if self.servo else 0.0)

    def clamp(self, value: float) -> float:
        """Return the nearest value within the range."""
        return min(max(value, self.low), self.high)


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint with a single coordinate: indices and range.

    Attributes:
        unit: of the range: ``radians`` or ``metres``.
    """

    key: str
    qpos: int
    qvel: int
    low: float
    high: float
    unit: str


@dataclass(frozen=True, slots=True)
class RobotParts:
    """Parts of one robot; ``base`` is the ``qpos`` address of a free joint, or None."""

    name: str
    model: str
    joints: dict[str, Joint]
    actuators: dict[str, Actuator]
    cameras: tuple[str, ...]
    tip: str
    root: str
    base: int | None


@dataclass(frozen=True, slots=True)
class CompiledScene:
    """A compiled scene: the model, the parts of each robot, and its start state."""

    scene: Scene
    model: Any
    robots: dict[str, RobotParts]
    start_qpos: Floats
    start_ctrl: Floats


def compile_scene(scene: Scene) -> CompiledScene:
    """Build and compile ``scene``.

    Raises:
        ValidationError: naming the robot whose model does not fit, or MuJoCo's reason.
    """
    spec = mujoco.MjSpec.from_file(str(FURNISHED))
    tips: dict[str, str] = {}
    homes: dict[str, Floats] = {}
    controls: dict[str, float] = {}
    if hasattr(mujoco, "mjtConflict"):
        # Sizes of user data that only a robot's file sets are taken over.
        spec.compiler.conflict = mujoco.mjtConflict.mjCONFLICT_MERGE
    children = [load_fitted(robot, scene) for robot in scene.robots]
    _yield_to(spec, children)
    set_options(spec, children, scene)
    for robot, child in zip(scene.robots, children, strict=True):
        tips[robot.name] = mark_tip(child, robot.tip)
        home, control = _attach(spec, robot, child)
        homes.update(home)
        controls.update(control)
    for item in scene.objects:
        _place(spec, item)
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as exc:
        raise ValidationError(f"the world does not compile: {' '.join(str(exc).split())[:300]}") from exc
    model.opt.timestep = scene.timestep
    robots = {r.name: _map_robot(model, r.name, r.source.label, tips[r.name]) for r in scene.robots}
    qpos, ctrl = _start(model, homes, controls)
    return CompiledScene(scene, model, robots, qpos, ctrl)


def in_floor(data: Any, owner: str) -> dict[str, float]:
    """Return the depth in a plane of each body of a robot or an object, metres.

    Physics pushes such a body out with force. ``data`` has a computed pose; its contacts are computed here.
    """
    model = data.model
    mujoco.mj_collision(model, data)
    depths: dict[str, float] = {}
    for index in range(data.ncon):
        contact = data.contact[index]
        geoms = sorted((int(geom) for geom in contact.geom), key=lambda g: int(model.geom_type[g]))
        if min(geoms) < 0 or int(model.geom_type[geoms[0]]) != mujoco.mjtGeom.mjGEOM_PLANE or contact.dist > -SUNK_M:
            continue
        name = str(model.body(int(model.geom_bodyid[geoms[1]])).name)
        if name == owner or name.startswith(f"{owner}/"):
            key = name.removeprefix(f"{owner}/")
            depths[key] = max(depths.get(key, 0.0), round(-float(contact.dist), 4))
    return depths


def sunk_sentence(depths: dict[str, float]) -> str:
    """Return a sentence about bodies in the floor, empty without one."""
    if not depths:
        return ""
    deep = ", ".join(f"{name} by {depth:g} m" for name, depth in depths.items())
    return f" In the floor: {deep}; place it higher."


def _attach(spec: Any, robot: SceneRobot, child: Any) -> tuple[dict[str, Floats], dict[str, float]]:
    """Put ``child`` into ``spec``; return its home pose and controls by full name."""
    try:
        home, control = _home(robot) if child.keys else ({}, {})
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


def _home(robot: SceneRobot) -> tuple[dict[str, Floats], dict[str, float]]:
    """Return the pose named home of a robot's file, else its first, by full name."""
    alone, prefix = robot.source.load(), f"{robot.name}/"
    name_parts(alone)
    model = alone.compile()
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    index = max(key, 0)
    pose: dict[str, Floats] = {}
    for joint in range(model.njnt):
        name = model.joint(joint).name
        # A free joint starts where the robot was placed, not where its own file puts it.
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            start = int(model.jnt_qposadr[joint])
            width = {1: 4}.get(int(model.jnt_type[joint]), 1)
            pose[prefix + name] = np.array(model.key_qpos[index][start : start + width])
    controls = {prefix + model.actuator(i).name: float(model.key_ctrl[index][i]) for i in range(model.nu)}
    return pose, controls


def _place(spec: Any, item: SceneObject) -> None:
    turned = [float(np.cos(item.yaw / 2)), 0, 0, float(np.sin(item.yaw / 2))]
    body = spec.worldbody.add_body(name=item.name, pos=list(item.position), quat=turned)
    if not item.fixed:
        body.add_freejoint(name=item.name)
    body.add_geom(
        name=item.name,
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{item.shape.upper()}"),
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
            # A servo without a given target starts at its present position.
            offset, slope = servo_line(model, index)
            wanted = offset + slope * float(data.actuator_length[index]) if is_servo(model, index) else 0.0
        low, high = model.actuator_ctrlrange[index] if model.actuator_ctrllimited[index] else (-np.inf, np.inf)
        ctrl[index] = min(max(wanted, low), high)
    return np.array(data.qpos), ctrl


def _map_robot(model: Any, name: str, label: str, tip: str) -> RobotParts:
    """Find the parts whose names start with ``name`` and a slash."""
    prefix = f"{name}/"
    joints: dict[str, Joint] = {}
    base: int | None = None
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
        key = full[len(prefix) :]
        low, high = model.jnt_range[index] if model.jnt_limited[index] else (-UNBOUNDED, UNBOUNDED)
        unit = "metres" if kind == mujoco.mjtJoint.mjJNT_SLIDE else "radians"
        joints[key] = Joint(key, address, int(model.jnt_dofadr[index]), float(low), float(high), unit)
    actuators: dict[str, Actuator] = {}
    for index in range(model.nu):
        full = model.actuator(index).name
        if not full.startswith(prefix):
            continue
        key = full[len(prefix) :]
        low, high = model.actuator_ctrlrange[index] if model.actuator_ctrllimited[index] else (-UNBOUNDED, UNBOUNDED)
        # MuJoCo computes an inherited range, which leaves 2.0 as 2.0000000000000004.
        bounds = round(float(low), 12), round(float(high), 12)
        actuators[key] = Actuator(key, index, *bounds, is_servo(model, index), *servo_line(model, index))
    cameras = tuple(n for n in (model.camera(i).name for i in range(model.ncam)) if n.startswith(prefix))
    return RobotParts(name, label, joints, actuators, cameras, prefix + tip if tip else "", _root(model, prefix), base)


def _root(model: Any, prefix: str) -> str:
    """Return the robot's first body."""
    return next((n for n in (str(model.body(i).name) for i in range(model.nbody)) if n.startswith(prefix)), "world")


def _yield_to(spec: Any, robots: Sequence[Any]) -> None:
    """Remove the floor, the lights and the sky of the world that a robot brings itself."""
    if any(is_floor(geom) for child in robots for geom in child.worldbody.geoms):
        for part in (spec.geom("floor"), spec.material("floor"), spec.texture("tiles")):
            spec.delete(part)
    if any(child.lights for child in robots):
        for name in ("key", "fill"):
            spec.delete(spec.light(name))
    if any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for child in robots for texture in child.textures):
        spec.delete(spec.texture("sky"))
