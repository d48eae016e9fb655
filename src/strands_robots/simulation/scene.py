"""The contents of a world as data, and the sources of robot models."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from strands_robots.kinematics.model_file import load_model
from strands_robots.utils import ValidationError, alike, choice, flag, identifier, number, shown, text

MODELS = Path(__file__).parents[1] / "models"
BUILT_IN = ("so100", "so101", "rover")
"""Models that come with the package; nothing is downloaded for them."""

ALIASES = {
    "so_arm100": "so100",
    "so-100": "so100",
    "so100_follower": "so100",
    "so_arm101": "so101",
    "so-101": "so101",
    "so101_follower": "so101",
}

_SUFFIXES = (".xml", ".mjcf", ".urdf")


@dataclass(frozen=True, slots=True)
class ModelSource:
    """A model's label and its file."""

    label: str
    path: Path

    def load(self) -> Any:
        """Return a fresh ``MjSpec``. Raises :class:`ValidationError` with the reason."""
        return load_model(self.path, self.label)


def find(model: object) -> ModelSource:
    """Return the source of a built-in name, a file, or a ``robot_descriptions`` name.

    Raises:
        ValidationError: no such model; the message names similar ones.
    """
    if isinstance(model, Path):
        model = str(model)
    if not isinstance(model, str) or not model.strip() or len(model) > 4096 or "\0" in model:
        raise ValidationError(f"model must be a model's name or the path of an MJCF or URDF file, not {shown(model)}.")
    name = ALIASES.get(model.lower(), model.lower())
    if name in BUILT_IN:
        return ModelSource(name, MODELS / f"{name}.xml")
    if model.lower().endswith(_SUFFIXES) or "/" in model:
        return _find_file(model)
    return _find_description(model)


def _find_file(model: str) -> ModelSource:
    path = Path(model).expanduser()
    if not path.is_file():
        raise ValidationError(f"model must be an existing MJCF or URDF file; there is no {shown(model)}.")
    if path.suffix.lower() not in _SUFFIXES:
        raise ValidationError(f"model must end in {', '.join(_SUFFIXES)}, not {shown(model)}.")
    return ModelSource(path.stem, path)


def _find_description(model: str) -> ModelSource:
    names = []
    if importlib.util.find_spec("robot_descriptions") is not None:
        names = sorted(importlib.import_module("robot_descriptions").DESCRIPTIONS)
    for candidate in (model, f"{model}_mj_description", f"{model}_description"):
        if candidate in names:
            # Importing one of these modules fetches the description unless its cache has it.
            try:
                module = importlib.import_module(f"robot_descriptions.{candidate}")
            except Exception as exc:  # that package clones with git, whose failures have no common type
                why = " ".join(str(exc).split())[:300] or type(exc).__name__
                raise ValidationError(f"model {shown(model)} cannot be fetched: {why}") from exc
            path = getattr(module, "MJCF_PATH", None) or getattr(module, "URDF_PATH", None)
            if isinstance(path, str):
                return ModelSource(model, Path(path))
    similar = alike(model.lower(), [*BUILT_IN, *ALIASES, *names], most=5)
    hint = f"near it: {', '.join(similar)}" if similar else f"known: {', '.join(BUILT_IN)}"
    raise ValidationError(f"model {shown(model)} is not known; {hint}. A path to an MJCF or URDF file works too.")


Triple = tuple[float, float, float]

REACH_M = 100.0
"""Largest coordinate of anything that is placed, in metres."""

SPACING_M = 0.45
"""Distance between robots that are added without a position, in metres."""

SHAPES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}
"""How many sizes each shape of an object has."""

TURN_RAD = 6.2831853072
"""Largest yaw of anything that is placed, in radians."""

_RESERVED = ("floor", "world")


@dataclass(frozen=True, slots=True)
class SceneRobot:
    """One robot: ``position`` in m, ``yaw`` in rad, ``tip`` a site or a body."""

    name: str
    source: ModelSource
    position: Triple = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    tip: str = ""

    @classmethod
    def checked(
        cls, name: object, model: str | Path | None, position: object, yaw: object, tip: object = ""
    ) -> SceneRobot:
        """Check a robot, and find its model, which may be fetched.

        :meth:`Simulation.add_robot` has the domains.

        Raises:
            ValidationError: an argument outside its domain, or no such model.
        """
        label = identifier("name", name)
        heading = number("yaw", yaw, low=-TURN_RAD, high=TURN_RAD)
        source = find(name if model is None else model)
        place = (0.0, 0.0, 0.0) if position is None else _triple("position", position)
        return cls(label, source, place, heading, text("tip", tip, longest=128, empty=True))


@dataclass(frozen=True, slots=True)
class SceneObject:
    """One object of primitive shape: metres, kilograms, radians, colour from 0 to 1."""

    name: str
    shape: str
    size: Triple
    position: Triple
    color: tuple[float, float, float, float]
    mass: float
    fixed: bool
    yaw: float = 0.0

    @classmethod
    def checked(
        cls,
        *,
        name: object,
        shape: object,
        size: object,
        position: object,
        color: object,
        mass: object,
        fixed: object,
        yaw: object = 0.0,
    ) -> SceneObject:
        """Check an object; see :meth:`Simulation.add_object` for the domains.

        Raises:
            ValidationError: an argument outside its domain.
        """
        kind = choice("shape", shape, tuple(SHAPES))
        return cls(
            identifier("name", name),
            kind,
            _sizes(kind, size),
            _triple("position", position),
            _colour(color),
            number("mass", mass, low=1e-4, high=1000),
            flag("fixed", fixed),
            number("yaw", yaw, low=-TURN_RAD, high=TURN_RAD),
        )


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything in the world.

    ``timestep`` in seconds, ``gravity`` in m/s² along z, ``density`` in kg/m³ and ``viscosity`` in Pa·s of the medium.
    """

    timestep: float = 0.002
    gravity: float = -9.81
    density: float = 0.0
    viscosity: float = 0.0
    robots: tuple[SceneRobot, ...] = ()
    objects: tuple[SceneObject, ...] = ()

    @classmethod
    def checked(cls, timestep: object, gravity: object, density: object, viscosity: object) -> Scene:
        """Return an empty scene. Raises :class:`ValidationError`."""
        return cls(
            number("timestep", timestep, low=1e-4, high=2e-2),
            number("gravity", gravity, low=-100, high=100),
            number("density", density, low=0, high=20_000),
            number("viscosity", viscosity, low=0, high=1000),
        )

    def with_robot(self, robot: SceneRobot, *, beside: bool = False) -> Scene:
        """Add a robot, ``beside`` those that are there or where its scene says.

        Raises:
            ValidationError: its name is taken.
        """
        self._require_free(robot.name)
        placed = replace(robot, position=(0.0, -SPACING_M * len(self.robots), 0.0)) if beside else robot
        return replace(self, robots=(*self.robots, placed))

    def without_robot(self, name: str) -> Scene:
        """Remove a robot."""
        return replace(self, robots=tuple(r for r in self.robots if r.name != name))

    def with_object(self, item: SceneObject) -> Scene:
        """Add an object. Raises :class:`ValidationError` where its name is taken."""
        self._require_free(item.name)
        return replace(self, objects=(*self.objects, item))

    def without_object(self, name: object) -> Scene:
        """Remove an object. Raises :class:`ValidationError` for an unknown name."""
        names = [o.name for o in self.objects]
        if name not in names:
            raise ValidationError(f"name must be one of {names}, not {shown(name)}.")
        return replace(self, objects=tuple(o for o in self.objects if o.name != name))

    def _require_free(self, name: str) -> None:
        if name in _RESERVED or name in {r.name for r in self.robots} | {o.name for o in self.objects}:
            raise ValidationError(f"name {shown(name)} is taken; choose another.")


def _triple(name: str, value: object) -> Triple:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValidationError(f"{name} must be three numbers, not {shown(value)}.")
    x, y, z = (number(f"{name}[{i}]", v, low=-REACH_M, high=REACH_M) for i, v in enumerate(value))
    return x, y, z


def _colour(value: object) -> tuple[float, float, float, float]:
    """Check red, green, blue and optionally alpha, each from 0 to 1."""
    if not isinstance(value, list | tuple) or len(value) not in (3, 4):
        raise ValidationError(f"color must be three or four numbers from 0 to 1, not {shown(value)}.")
    r, g, b, a = (number(f"color[{i}]", v, low=0, high=1) for i, v in enumerate([*value, 1.0][:4]))
    return r, g, b, a


def _sizes(shape: str, value: object) -> Triple:
    """Check a shape's sizes and add zeros up to three; a cube needs one number."""
    count = SHAPES[shape]
    values = list(value) if isinstance(value, list | tuple) else [value]
    if count == 3 and len(values) == 1:
        values = values * 3
    if len(values) != count:
        raise ValidationError(
            f"size of a {shape} must be {count} number{'s' if count > 1 else ''} in metres, not {shown(value)}."
        )
    checked = [number(f"size[{i}]", v, low=0.001, high=10) for i, v in enumerate(values)]
    x, y, z = [*checked, 0.0, 0.0][:3]
    return x, y, z
