"""The door of the simulation's verbs: argument domains, and refusals turned into envelopes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec

from strands_robots.envelope import Envelope, error
from strands_robots.safety.gate import MotionRefused
from strands_robots.simulation.stage import SHAPES, ObjectPlan, Triple
from strands_robots.utils import ValidationError, choice, flag, identifier, number, shown

P = ParamSpec("P")

REACH_M = 100.0
"""Furthest from the origin that anything may be placed, in metres."""

STEPS_MAX = 1_000_000
"""Most steps of one call: about half a minute of computing for one arm."""

TIMESTEP_MIN, TIMESTEP_MAX = 1e-4, 2e-2


def answered(verb: Callable[P, Envelope]) -> Callable[P, Envelope]:
    """Let ``verb`` refuse by raising: the caller gets the refusal as an envelope, never an exception."""

    @functools.wraps(verb)
    def answering(*args: P.args, **kwargs: P.kwargs) -> Envelope:
        try:
            return verb(*args, **kwargs)
        except ValidationError as refused:
            return error(str(refused))
        except MotionRefused as refused:
            return refused.envelope

    return answering


def triple(name: str, value: object, *, low: float = -REACH_M, high: float = REACH_M) -> Triple:
    """Three finite numbers from ``low`` to ``high``."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValidationError(f"{name} must be three numbers, not {shown(value)}.")
    x, y, z = (number(f"{name}[{i}]", v, low=low, high=high) for i, v in enumerate(value))
    return x, y, z


def colour(value: object) -> tuple[float, float, float, float]:
    """Red, green, blue and optionally alpha, each from 0 to 1."""
    if not isinstance(value, list | tuple) or len(value) not in (3, 4):
        raise ValidationError(f"color must be three or four numbers from 0 to 1, not {shown(value)}.")
    r, g, b, a = (number(f"color[{i}]", v, low=0, high=1) for i, v in enumerate([*value, 1.0][:4]))
    return r, g, b, a


def extents(shape: str, value: object) -> Triple:
    """MuJoCo's half sizes of a shape: one number for a sphere, two for a cylinder or capsule, three for a box."""
    wanted = {"sphere": 1, "cylinder": 2, "capsule": 2, "box": 3}[shape]
    values = list(value) if isinstance(value, list | tuple) else [value]
    if wanted == 3 and len(values) == 1:
        values = values * 3
    if len(values) != wanted:
        raise ValidationError(
            f"size of a {shape} must be {wanted} number{'s' if wanted > 1 else ''} in metres, not {shown(value)}."
        )
    checked = [number(f"size[{i}]", v, low=0.001, high=10) for i, v in enumerate(values)]
    x, y, z = [*checked, 0.0, 0.0][:3]
    return x, y, z


def object_plan(
    *, name: object, shape: object, size: object, position: object, color: object, mass: object, fixed: object
) -> ObjectPlan:
    """A checked object; see :meth:`Simulation.add_object` for the domains."""
    kind = choice("shape", shape, SHAPES)
    return ObjectPlan(
        identifier("name", name),
        kind,
        extents(kind, size),
        triple("position", position),
        colour(color),
        number("mass", mass, low=1e-4, high=1000),
        flag("fixed", fixed),
    )


def pixels(name: str, value: Any, most: int) -> int:
    """A picture's width or height."""
    if isinstance(value, bool) or not isinstance(value, int) or not 16 <= value <= most:
        raise ValidationError(f"{name} must be an integer from 16 to {most}, not {shown(value)}.")
    return value
