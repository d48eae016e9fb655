"""Spare bodies of a chain's model, made obstacles without a compilation.

MuJoCo keeps the interpreter while it compiles a model, for tens of milliseconds where that has meshes. This one is
compiled once with the chain; each plan takes a copy of it in memory and sets the sizes and places of its obstacles.
"""

from __future__ import annotations

import copy
import threading
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

COUNT = 32
"""Spare bodies of a model; more obstacles than that compile it anew."""

BITS = 0x7FFFFFFF
"""Contact bits that meet every geom which meets any other."""

_AWAY_M = 1000.0
"""Depth at which a spare body waits, where no ray or contact of the arm meets it."""

_NAME = "spare obstacle"
_HELD = "spare held object"
_SMALL_M = 1e-3

BOX, CYLINDER, BALL = (
    mujoco.mjtGeom.mjGEOM_BOX.value,
    mujoco.mjtGeom.mjGEOM_CYLINDER.value,
    mujoco.mjtGeom.mjGEOM_SPHERE.value,
)

Floats = NDArray[np.float64]


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
        _wait(site.parent.add_body(name=_HELD, pos=[0, 0, -_AWAY_M]))
        self._model = self._grown(COUNT)

    def model(self, count: int) -> Any:
        """Return a model of its own with room for so many obstacles."""
        with self._growing:
            if count > self._count:
                self._model = self._grown(count)
            return copy.copy(self._model)

    def _grown(self, count: int) -> Any:
        """Compile the model with more spare bodies."""
        for index in range(self._count, count):
            _wait(self._spec.worldbody.add_body(name=f"{_NAME} {index}", pos=[0, 0, -_AWAY_M * (1 + index)]))
        self._count = count
        model = self._compiled()
        for body in (held_body(model), *(body_of(model, index) for index in range(count))):
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


def body_of(model: Any, index: int) -> int:
    """Return the body of a spare obstacle."""
    return int(model.body(f"{_NAME} {index}").id)


def held_body(model: Any) -> int:
    """Return the spare body that goes where the tip goes."""
    return int(model.body(_HELD).id)


@dataclass(frozen=True, slots=True)
class Shape:
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


def put(model: Any, body: int, shape: Shape) -> None:
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
    _meets(model, body, BITS)


def _wait(body: Any) -> None:
    body.add_geom(type=BOX, size=[_SMALL_M] * 3, contype=BITS, conaffinity=BITS)


def _meets(model: Any, body: int, bits: int) -> None:
    geom = int(model.body_geomadr[body])
    model.geom_contype[geom] = model.geom_conaffinity[geom] = bits
    model.body_contype[body] = model.body_conaffinity[body] = bits
