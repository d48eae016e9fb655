"""A model's file made fit for a world that it shares with others.

MuJoCo has one set of options for a whole world. What a file sets there is confined to the model's own parts, refused
by name, or left at the world's value, so that no model changes the physics of its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from strands_robots.simulation.catalog import ModelSource
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.plan import Plan, RobotPlan
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


def load_fitted(robot: RobotPlan, plan: Plan) -> Any:
    """Return the ``MjSpec`` of a robot's model, fit for the world of ``plan``.

    Raises:
        ValidationError: the file cannot be loaded, or needs what a shared world cannot give.
    """
    child = load_named(robot.source)
    try:
        _require_medium(child.option, plan)
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


def set_options(world: Any, models: Sequence[Any], plan: Plan) -> None:
    """Give the world and every model in it the options of the world.

    A file may make the solver more exact, never less; the world decides everything else.
    """
    option = mujoco.MjSpec().option
    for name in _EXACTNESS:
        setattr(option, name, max(getattr(spec.option, name) for spec in (world, *models)))
    option.timestep = plan.timestep
    option.gravity = [0, 0, plan.gravity]
    option.density, option.viscosity = plan.density, plan.viscosity
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


def _require_medium(option: Any, plan: Plan) -> None:
    """Refuse a medium that is not the world's, wind, and disabled actuators."""
    own = {"density": float(option.density), "viscosity": float(option.viscosity)}
    if any(own.values()) and own != {"density": plan.density, "viscosity": plan.viscosity}:
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
