"""The visible geometry of a pose as flat faces, for the software picture."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.stage import Floats, Stage

_VISIBLE_GROUPS = 3
"""Geometry groups 0 to 2 are shown, as MuJoCo does by default; 3 is collision shapes."""

_ROUND = 20
_MESH_FACES_MAX = 1000

Patch = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True)
class Face:
    """A flat convex face: corners (n, 3) in metres, anticlockwise seen from outside; ``colour`` 0 to 255."""

    points: Floats
    normal: Floats
    colour: Floats
    shine: float


def faces_of(stage: Stage, data: Any) -> tuple[list[Face], bool]:
    """Every visible face in world coordinates, and whether there is a floor."""
    model = stage.model
    faces: list[Face] = []
    floor = False
    for index in range(model.ngeom):
        kind = int(model.geom_type[index])
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            floor = True
            continue
        colour, shine = _look(model, index)
        if int(model.geom_group[index]) >= _VISIBLE_GROUPS or colour[3] < 0.05:
            continue
        rotation, position = data.geom_xmat[index].reshape(3, 3), data.geom_xpos[index]
        for patch in _patches(model, index, kind):
            points = np.asarray(patch) @ rotation.T + position
            normal = np.cross(points[1] - points[0], points[-1] - points[0])
            length = float(np.linalg.norm(normal))
            if length > 0:
                faces.append(Face(points, normal / length, colour[:3] * 255.0, shine))
    return faces, floor


def _look(model: Any, index: int) -> tuple[Floats, float]:
    material = int(model.geom_matid[index])
    if material < 0:
        return np.array(model.geom_rgba[index], dtype=np.float64), 0.3
    return np.array(model.mat_rgba[material], dtype=np.float64), float(model.mat_specular[material])


def _patches(model: Any, index: int, kind: int) -> tuple[Patch, ...]:
    x, y, z = (float(v) for v in model.geom_size[index])
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_BOX:
        return _box(x, y, z)
    if kind == types.mjGEOM_SPHERE:
        return _lathe(_arc(x, 0.0, -1.0, 1.0), x, x)
    if kind == types.mjGEOM_ELLIPSOID:
        return _ellipsoid(x, y, z)
    if kind == types.mjGEOM_CYLINDER:
        return _lathe(((0.0, -y), (x, -y), (x, y), (0.0, y)), x, y)
    if kind == types.mjGEOM_CAPSULE:
        return _lathe(_arc(x, -y, -1.0, 0.0) + _arc(x, y, 0.0, 1.0), x, y)
    return _mesh(model, int(model.geom_dataid[index])) if kind == types.mjGEOM_MESH else ()


@lru_cache(maxsize=512)
def _box(x: float, y: float, z: float) -> tuple[Patch, ...]:
    a, b, c, d = (-x, -y), (x, -y), (x, y), (-x, y)
    sides = tuple(((*p, -z), (*q, -z), (*q, z), (*p, z)) for p, q in ((a, b), (b, c), (c, d), (d, a)))
    top = tuple((*p, z) for p in (a, b, c, d))
    bottom = tuple((*p, -z) for p in (d, c, b, a))
    return (*sides, top, bottom)


def _arc(radius: float, height: float, start: float, end: float) -> tuple[tuple[float, float], ...]:
    """Profile of a part of a sphere: (radius, z) from ``start`` to ``end`` quarter turns above the equator."""
    angles = np.linspace(start, end, 9 if end - start > 1 else 5) * np.pi / 2
    return tuple((float(radius * np.cos(a)), float(height + radius * np.sin(a))) for a in angles)


@lru_cache(maxsize=512)
def _lathe(profile: tuple[tuple[float, float], ...], _radius: float, _half: float) -> tuple[Patch, ...]:
    """Turn a profile of (radius, z), from the bottom up, about the z axis."""
    turns = np.linspace(0, 2 * np.pi, _ROUND + 1)
    circle = [(float(np.cos(t)), float(np.sin(t))) for t in turns]
    patches: list[Patch] = []
    for (r0, z0), (r1, z1) in itertools.pairwise(profile):
        if max(r0, r1) < 1e-9:
            continue
        if z0 == z1:
            ring = tuple((max(r0, r1) * c, max(r0, r1) * s, z0) for c, s in circle[:-1])
            patches.append(ring if r0 > r1 else tuple(reversed(ring)))
            continue
        for (c0, s0), (c1, s1) in itertools.pairwise(circle):
            corners = [(r0 * c0, r0 * s0, z0), (r0 * c1, r0 * s1, z0), (r1 * c1, r1 * s1, z1), (r1 * c0, r1 * s0, z1)]
            patches.append(tuple(corners[1:] if r0 < 1e-9 else corners[:3] if r1 < 1e-9 else corners))
    return tuple(patches)


@lru_cache(maxsize=64)
def _ellipsoid(x: float, y: float, z: float) -> tuple[Patch, ...]:
    unit = _lathe(_arc(1.0, 0.0, -1.0, 1.0), 1.0, 1.0)
    return tuple(tuple((px * x, py * y, pz * z) for px, py, pz in patch) for patch in unit)


def _hull(model: Any, mesh: int) -> Any:
    """Triangles of a mesh's convex hull, of vertices of that mesh; the layout is that of ``mesh_graph`` in MuJoCo's
    ``mjModel``: two counts, two numbers a vertex, one an edge, then three a face."""
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        return ()
    vertices, count = (int(v) for v in model.mesh_graph[start : start + 2])
    begin = start + 2 + 3 * vertices + 3 * count
    return model.mesh_graph[begin : begin + 3 * count].reshape(-1, 3)


def _mesh(model: Any, mesh: int) -> tuple[Patch, ...]:
    if mesh < 0:
        return ()
    first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertices = model.mesh_vert[int(model.mesh_vertadr[mesh]) :]
    triangles = model.mesh_face[first : first + count]
    if count > _MESH_FACES_MAX:
        # A picture that takes a minute is of no use: the convex hull where MuJoCo has one, else every nth face.
        hull = _hull(model, mesh)
        triangles = hull if len(hull) else triangles[:: count // _MESH_FACES_MAX]
    return tuple(tuple(tuple(float(v) for v in vertices[i]) for i in corner) for corner in triangles)  # type: ignore[misc]
