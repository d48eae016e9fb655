"""Cameras and pictures of a world, with or without OpenGL, and files of motions.

An OpenGL context belongs to one thread. Each world has one rendering thread that owns its contexts, started with
the first picture and ended by ``cleanup``; callers of any thread submit work to it and wait. It draws from a snapshot
and its own copy of the data, so that it never delays physics.

Without OpenGL pictures are drawn in numpy alone. That is slower and plainer: one light, its shadow on the floor, flat
faces. Every primitive and mesh is drawn; textures other than the floor's are not.
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from strands_robots.errors import StrandsRobotsError
from strands_robots.simulation.engine import BACKEND, mujoco, remedy
from strands_robots.simulation.model import MAX_HEIGHT, MAX_WIDTH, PICTURE, CompiledScene, Floats
from strands_robots.simulation.physics import Physics, Snapshot
from strands_robots.utils import ValidationError, flag, shown

Picture = NDArray[np.uint8]

OVERVIEW = "overview"
AZIMUTH, ELEVATION = 128.0, -20.0
"""Direction of the overview, in degrees, as MuJoCo's free camera counts them."""

_CONTEXTS_MAX = 3
"""Contexts cached for different sizes and qualities; an older one is freed."""

_LINE_SCALE = 3
"""Lines are drawn this many times larger and scaled down, so that they are smooth."""

_EARLY, _LATE = np.array([60, 120, 235]), np.array([235, 55, 95])


class RenderingError(StrandsRobotsError, RuntimeError):
    """OpenGL does not work on this machine; the message says what to install."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """Pose and opening angle of a camera.

    ``position`` is in metres, ``rotation`` has its right, up and backward axes as columns, ``fovy`` is the height of
    the picture in degrees. ``lookat`` and ``distance`` are those of the overview, else None and 0.
    """

    camera: str
    position: Floats
    rotation: Floats
    fovy: float
    lookat: Floats | None = None
    distance: float = 0.0

    def pixels(self, points: Iterable[Iterable[float]], width: int, height: int) -> Floats:
        """Convert points (n, 3) in m to pixels x (right), y (down), and depth in m."""
        local = (np.array([list(p) for p in points], dtype=np.float64).reshape(-1, 3) - self.position) @ self.rotation
        depth = -local[:, 2]
        scale = height / 2 / np.tan(np.radians(self.fovy) / 2)
        safe = np.maximum(depth, 1e-6)
        x, y = width / 2 + scale * local[:, 0] / safe, height / 2 - scale * local[:, 1] / safe
        return np.stack([x, y, depth], axis=1)


def picture_size(width: object, height: object) -> tuple[int, int]:
    """Check a picture's width and height. Raises :class:`ValidationError`."""
    return _pixels("width", width, MAX_WIDTH), _pixels("height", height, MAX_HEIGHT)


def _pixels(name: str, value: object, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 16 <= value <= most:
        raise ValidationError(f"{name} must be an integer from 16 to {most}, not {shown(value)}.")
    return value


def camera_names(compiled: CompiledScene) -> list[str]:
    """Return every camera that a picture can be taken with."""
    return [OVERVIEW, *(str(compiled.model.camera(i).name) for i in range(compiled.model.ncam))]


def find_camera(compiled: CompiledScene, name: object) -> str:
    """Return a camera's full name; its part without the robot is enough if unique.

    Raises:
        ValidationError: no such camera, or several robots have one of that name.
    """
    names = camera_names(compiled)
    if isinstance(name, str):
        if name in names:
            return name
        ends = [n for n in names if n.endswith(f"/{name}")]
        if len(ends) == 1:
            return ends[0]
    raise ValidationError(f"camera must be one of {', '.join(names)}, not {shown(name)}.")


def camera_view(compiled: CompiledScene, data: Any, camera: object) -> CameraView:
    """Return the view of ``camera`` in ``data``. Raises as :func:`find_camera`."""
    name = find_camera(compiled, camera)
    if name != OVERVIEW:
        index = compiled.model.camera(name).id
        return CameraView(
            name,
            data.cam_xpos[index].copy(),
            data.cam_xmat[index].reshape(3, 3).copy(),
            float(compiled.model.cam_fovy[index]),
        )
    lookat, distance = _fit(compiled, data)
    azimuth, elevation = np.radians(AZIMUTH), np.radians(ELEVATION)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(right, forward), -forward], axis=1)
    fovy = float(compiled.model.vis.global_.fovy)
    return CameraView(name, lookat - distance * forward, rotation, fovy, lookat, distance)


def _fit(compiled: CompiledScene, data: Any) -> tuple[Floats, float]:
    """Return the point and the distance from which every robot's reach is visible."""
    model = compiled.model
    prefixes = tuple(f"{name}/" for name in compiled.robots)
    bodies = [i for i in range(model.nbody) if prefixes and model.body(i).name.startswith(prefixes)]
    if not bodies:
        return np.array([0.15, 0.0, 0.1]), 1.0
    spots = data.xpos[bodies]
    # The feet stay in place while the arms swing: centring on them keeps the picture still.
    feet = np.array([data.xpos[model.body_rootid[i]] for i in bodies])
    low, high = feet.min(axis=0), feet.max(axis=0)
    spread = float(np.linalg.norm(high - low))
    tallest = float(min(max(spots[:, 2].max(), 0.1), 1.0))
    centre = (low + high) / 2 + np.array([0.11, 0.0, 0.0])
    return np.array([centre[0], centre[1], 0.13 if tallest > 0.15 else 0.06]), 0.95 + 0.85 * spread


class Renderer:
    """The rendering thread of one world."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="simulation-render")
        self._compiled: CompiledScene | None = None
        self._data: Any = None
        self._contexts: dict[tuple[int, int, bool], Any] = {}
        # A program that ends without cleanup frees them while OpenGL is still there.
        weakref.finalize(self, _free, self._contexts)

    def render(self, snapshot: Snapshot, camera: object, width: int, height: int, *, quality: bool) -> Picture:
        """Draw an RGB picture (height, width, 3).

        ``quality`` adds shadows, reflections and anti-aliasing, which cost many times the time in software.

        Raises:
            RenderingError: OpenGL does not work here.
            ValidationError: no such camera.
        """
        name = find_camera(snapshot.compiled, camera)
        return self._thread.submit(self._render, snapshot, name, width, height, quality).result()

    def close(self) -> None:
        """Free every context and end the thread."""
        self._thread.submit(_free, self._contexts).result()
        self._thread.shutdown()

    def _render(self, snapshot: Snapshot, camera: str, width: int, height: int, quality: bool) -> Picture:
        if self._compiled is not snapshot.compiled:
            _free(self._contexts)
            self._compiled = snapshot.compiled
            self._data = mujoco.MjData(snapshot.compiled.model)
        renderer = self._context(snapshot.compiled, width, height, quality)
        snapshot.pose(self._data)
        view = camera_view(snapshot.compiled, self._data, camera)
        renderer.update_scene(self._data, _mujoco_camera(view))
        flags = renderer.scene.flags
        for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            flags[effect] = quality
        picture: Picture = renderer.render()
        return picture

    def _context(self, compiled: CompiledScene, width: int, height: int, quality: bool) -> Any:
        key = (width, height, quality)
        if key in self._contexts:
            return self._contexts[key]
        while len(self._contexts) >= _CONTEXTS_MAX:
            self._contexts.pop(next(iter(self._contexts))).close()
        visual = compiled.model.vis
        visual.global_.offwidth, visual.global_.offheight = width, height
        visual.quality.shadowsize = 4096 if quality else 0
        visual.quality.offsamples = 8 if quality else 0
        try:
            self._contexts[key] = mujoco.Renderer(compiled.model, height, width)
        except Exception as exc:
            # Each OpenGL binding raises its own kind when its library or driver is missing.
            why = " ".join(str(exc).split())[:200]
            raise RenderingError(f"no OpenGL picture (MUJOCO_GL={BACKEND or 'unset'}: {why}); {remedy()}.") from exc
        return self._contexts[key]


def _free(contexts: dict[tuple[int, int, bool], Any]) -> None:
    while contexts:
        contexts.popitem()[1].close()


def _mujoco_camera(view: CameraView) -> Any:
    if view.lookat is None:
        return view.camera
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat = view.lookat
    camera.distance = view.distance
    forward = -view.rotation[:, 2]
    camera.azimuth = float(np.degrees(np.arctan2(forward[1], forward[0])))
    camera.elevation = float(np.degrees(np.arcsin(forward[2])))
    return camera


def draw_path(picture: Picture, points: Floats) -> Picture:
    """Return a copy of ``picture`` with a line through ``points`` (n, 2+) in pixels.

    The line is blue at its start and red at its end, which has a dot. Points behind the camera (a third column of
    depth below zero) are left out.
    """
    visible = points if points.shape[1] < 3 else points[points[:, 2] > 0]
    height, width = picture.shape[:2]
    layer = Image.new("RGBA", (width * _LINE_SCALE, height * _LINE_SCALE), (0, 0, 0, 0))
    pen = ImageDraw.Draw(layer)
    thick = max(2, round(height * _LINE_SCALE / 160))
    for index in range(len(visible) - 1):
        share = (index + 1) / max(1, len(visible) - 1)
        colour = tuple(int(v) for v in _EARLY * (1 - share) + _LATE * share)
        (x0, y0), (x1, y1) = visible[index][:2] * _LINE_SCALE, visible[index + 1][:2] * _LINE_SCALE
        pen.line((x0, y0, x1, y1), fill=(*colour, 235), width=thick)
        pen.ellipse((x1 - thick / 2, y1 - thick / 2, x1 + thick / 2, y1 + thick / 2), fill=(*colour, 235))
    if len(visible):
        x, y = visible[-1][:2] * _LINE_SCALE
        pen.ellipse((x - 1.6 * thick, y - 1.6 * thick, x + 1.6 * thick, y + 1.6 * thick), fill=(255, 255, 255, 255))
        pen.ellipse((x - thick, y - thick, x + thick, y + thick), fill=(*(int(v) for v in _LATE), 255))
    layer = layer.resize((width, height), Image.Resampling.LANCZOS)
    return np.asarray(Image.alpha_composite(Image.fromarray(picture).convert("RGBA"), layer).convert("RGB")).copy()


Pixels = NDArray[np.float32]

_LIGHT = np.array([0.42, -0.42, 0.80]) / np.linalg.norm([0.42, -0.42, 0.80])
_SKY_TOP, _SKY_LOW = np.array([[150, 178, 208], [233, 238, 244]], dtype=np.float32)
_TILE_M = 0.1
_TILE_A, _TILE_B, _SEAM = np.array([[206, 211, 218], [197, 203, 212], [178, 186, 196]], dtype=np.float32)
_SHADOW_CELL_M = 0.004
_FINE = 2
"""Anti-aliasing: pictures are drawn this many times larger and averaged."""

_VISIBLE_GROUPS = 3
"""Geometry groups 0 to 2 are shown, as MuJoCo does by default; 3 is collision shapes."""

_ROUND = 20
_MESH_FACES_MAX = 1000

Patch = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True)
class Face:
    """A flat convex face: corners (n, 3) in metres, anticlockwise; colour 0 to 255."""

    points: Floats
    normal: Floats
    colour: Floats
    shine: float


def draw(compiled: CompiledScene, data: Any, view: CameraView, width: int, height: int) -> NDArray[np.uint8]:
    """Draw the picture (height, width, 3) that ``view`` has of the pose in ``data``."""
    wide, high = width * _FINE, height * _FINE
    faces, floor = _faces(compiled, data)
    image, depth = _background(view, wide, high, faces if floor else None)
    for face in faces:
        _fill(image, depth, face, view)
    fine = np.clip(image, 0, 255).reshape(height, _FINE, width, _FINE, 3)
    picture: NDArray[np.uint8] = fine.mean(axis=(1, 3)).astype(np.uint8)
    return picture


def _fill(image: Pixels, depth: Pixels, face: Face, view: CameraView) -> None:
    """Draw one convex face wherever it is nearer than the faces already drawn."""
    towards = view.position - face.points[0]
    if float(face.normal @ towards) <= 0:
        return
    high, wide = depth.shape
    corners = view.pixels(face.points, wide, high)
    if corners[:, 2].min() < 0.005:
        return
    x0, y0 = np.maximum(np.floor(corners[:, :2].min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(corners[:, :2].max(axis=0)).astype(int) + 1, [wide, high])
    if x0 >= x1 or y0 >= y1:
        return
    xs, ys = np.arange(x0, x1) + 0.5, (np.arange(y0, y1) + 0.5)[:, None]
    inside = np.ones((y1 - y0, x1 - x0), dtype=bool)
    following = np.roll(corners, -1, axis=0)
    for (ax, ay, _), (bx, by, _) in zip(corners, following, strict=True):
        inside &= (bx - ax) * (ys - ay) - (by - ay) * (xs - ax) <= 0
    if not inside.any():
        return
    # One over depth is linear over the picture for points of one plane; the plane's equation gives it exactly.
    scale = high / 2 / np.tan(np.radians(view.fovy) / 2)
    rays_x, rays_y = (xs - wide / 2) / scale, (high / 2 - ys) / scale
    normal = face.normal @ view.rotation
    offset = float(face.normal @ -towards)
    inverse = (normal[0] * rays_x + normal[1] * rays_y - normal[2]) / offset
    drawn = depth[y0:y1, x0:x1]
    visible = inside & (inverse > drawn)
    drawn[visible] = inverse[visible]
    image[y0:y1, x0:x1][visible] = _shade(face, towards)


def _shade(face: Face, towards: Floats) -> Floats:
    lit = max(0.0, float(face.normal @ _LIGHT))
    sky = 0.5 + 0.5 * float(face.normal[2])
    half = _LIGHT + towards / np.linalg.norm(towards)
    gloss = max(0.0, float(face.normal @ half) / float(np.linalg.norm(half))) ** 24
    return face.colour * (0.30 + 0.16 * sky + 0.58 * lit) + 255.0 * 0.18 * face.shine * gloss * (lit > 0)


def _background(view: CameraView, wide: int, high: int, shadow_of: list[Face] | None) -> tuple[Pixels, Pixels]:
    """Draw the sky, and the floor with its shadows; the buffer has one over depth."""
    ramp = np.linspace(0, 1, high, dtype=np.float32)[:, None, None]
    image = np.broadcast_to(_SKY_TOP * (1 - ramp) + _SKY_LOW * ramp, (high, wide, 3)).astype(np.float32)
    depth = np.zeros((high, wide), dtype=np.float32)
    if shadow_of is None:
        return image, depth
    scale = high / 2 / np.tan(np.radians(view.fovy) / 2)
    across = ((np.arange(wide) + 0.5 - wide / 2) / scale).astype(np.float32)
    down = ((high / 2 - np.arange(high) - 0.5) / scale).astype(np.float32)[:, None]
    right, up, back = (axis.astype(np.float32) for axis in view.rotation.T)
    slope = right[2] * across + up[2] * down - back[2]
    rows = np.flatnonzero((slope < -1e-4).any(axis=1))
    if not len(rows) or view.position[2] <= 0:
        return image, depth
    # Rows above the first one that meets the floor show only sky.
    below = slice(int(rows[0]), int(rows[-1]) + 1)
    down, slope, sky = down[below], slope[below], image[below]
    hit = slope < -1e-4
    reach = np.where(hit, np.float32(-view.position[2]) / np.where(hit, slope, -1), 0)
    x = np.float32(view.position[0]) + reach * (right[0] * across + up[0] * down - back[0])
    y = np.float32(view.position[1]) + reach * (right[1] * across + up[1] * down - back[1])
    shade = _tiles(x, y, reach) * (1 - 0.42 * _shadow(shadow_of, x, y))[..., None]
    haze = np.clip((reach - 1.0) / 4.0, 0, 1)[..., None]
    image[below] = np.where(hit[..., None], shade * (1 - haze) + sky * haze, sky)
    depth[below] = np.where(hit, 1 / np.maximum(reach, 1e-6), 0)
    return image, depth


def _tiles(x: Pixels, y: Pixels, reach: Pixels) -> Pixels:
    """Return the floor's colours at points (m), seen from ``reach`` metres.

    A seam narrower than a pixel would flicker, so seams fade with the distance.
    """
    u, v = x / np.float32(_TILE_M), y / np.float32(_TILE_M)
    column, row = np.floor(u), np.floor(v)
    seam = np.maximum(np.abs(u - column - 0.5), np.abs(v - row - 0.5)) > 0.485
    strength = (np.clip(1.2 - reach / 1.2, 0, 1) * seam)[..., None]
    odd = ((column + row) % 2 < 1)[..., None]
    tiles: Pixels = np.where(odd, _TILE_A, _TILE_B) * (1 - strength) + _SEAM * strength
    return tiles


def _shadow(faces: list[Face], x: Pixels, y: Pixels) -> Pixels:
    """Return the share of light that each floor point lacks: soft projected faces."""
    laid = [f.points[:, :2] - _LIGHT[:2] / _LIGHT[2] * np.maximum(f.points[:, 2:], 0) for f in faces]
    if not laid:
        return np.zeros_like(x)
    everything = np.concatenate(laid)
    low = everything.min(axis=0) - 0.05
    cells = np.minimum(np.ceil((everything.max(axis=0) + 0.05 - low) / _SHADOW_CELL_M).astype(int), 1500)
    mask = np.zeros((cells[1], cells[0]), dtype=np.float32)
    for points in laid:
        _cover(mask, (points - low) / _SHADOW_CELL_M)
    for axis in (0, 1):
        mask = (np.roll(mask, 1, axis) + 2 * mask + np.roll(mask, -1, axis)) / 4
    column = ((x - low[0]) / _SHADOW_CELL_M).astype(int)
    row = ((y - low[1]) / _SHADOW_CELL_M).astype(int)
    within = (column >= 0) & (column < cells[0]) & (row >= 0) & (row < cells[1])
    shade = np.zeros_like(x)
    shade[within] = mask[row[within], column[within]]
    return shade


def _cover(mask: Pixels, points: Floats) -> None:
    """Fill one convex polygon, given in cells in either direction of rotation."""
    x0, y0 = np.maximum(np.floor(points.min(axis=0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(points.max(axis=0)).astype(int) + 1, mask.shape[::-1])
    if x0 >= x1 or y0 >= y1:
        return
    xs, ys = np.arange(x0, x1) + 0.5, (np.arange(y0, y1) + 0.5)[:, None]
    sides = [
        (bx - ax) * (ys - ay) - (by - ay) * (xs - ax)
        for (ax, ay), (bx, by) in zip(points, np.roll(points, -1, axis=0), strict=True)
    ]
    inside = np.logical_and.reduce([s >= 0 for s in sides]) | np.logical_and.reduce([s <= 0 for s in sides])
    mask[y0:y1, x0:x1][inside] = 1.0


def _faces(compiled: CompiledScene, data: Any) -> tuple[list[Face], bool]:
    """Return every visible face in world coordinates, and True with a floor."""
    model = compiled.model
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
    """Return (radius, z) of an arc from ``start`` to ``end`` quarter turns up."""
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
    """Return the triangles of a mesh's convex hull, as indices of its vertices.

    ``mesh_graph`` in MuJoCo's ``mjModel`` has two counts, two numbers a vertex, one an edge, then three a face.
    """
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
        # Drawing every face would take a minute: use the convex hull where MuJoCo has one, else every nth face.
        hull = _hull(model, mesh)
        triangles = hull if len(hull) else triangles[:: count // _MESH_FACES_MAX]
    return tuple(tuple(tuple(float(v) for v in vertices[i]) for i in corner) for corner in triangles)  # type: ignore[misc]


class PicturesMixin:
    """Pictures of a world that has the members declared here."""

    has_cameras = True
    """Every world has an overview."""

    physics: Physics
    _renderer: Renderer

    def _require_open(self) -> None:
        """Raise :class:`ValidationError` once the world was cleaned up."""
        raise NotImplementedError

    def tip_position(self, robot_name: str | None = None) -> tuple[float, float, float]:
        """Return the place of one robot's tip, in metres."""
        raise NotImplementedError

    def render(self, camera: str = OVERVIEW, width: int = 320, height: int = 240, *, quality: bool = False) -> Picture:
        """Draw a picture by OpenGL: RGB, (height, width, 3), unsigned bytes.

        Args:
            camera: overview, front, side, top, table, or a robot's own (``wrist``, or ``arm/wrist`` where several
                have one).
            width: 16 to 1920 pixels.
            height: 16 to 1440 pixels.
            quality: with shadows and anti-aliasing, at many times the cost in software.

        Raises:
            ValidationError: an argument outside its domain.
            RenderingError: OpenGL does not work on this machine; the message says which package is missing.
        """
        size, best = picture_size(width, height), flag("quality", quality)
        self._require_open()
        return self._renderer.render(self.physics.snapshot, camera, *size, quality=best)

    def project(self, camera: str = OVERVIEW, width: int = 320, height: int = 240) -> Picture:
        """Draw the same picture without OpenGL; arguments as for :meth:`render`."""
        size = picture_size(width, height)
        snapshot = self.physics.snapshot
        data = snapshot.data()
        return draw(snapshot.compiled, data, camera_view(snapshot.compiled, data, camera), *size)

    def picture(
        self,
        camera: str = OVERVIEW,
        width: int = 640,
        height: int = 480,
        *,
        path: Iterable[tuple[float, float, float]] = (),
    ) -> tuple[Picture, Literal["opengl", "projection"]]:
        """Draw the best possible picture and ``path`` (m); return it and its method."""
        how: Literal["opengl", "projection"] = "opengl"
        try:
            picture = self.render(camera, width, height, quality=True)
        except RenderingError:
            how, picture = "projection", self.project(camera, width, height)
        points = list(path)
        if points:
            picture = draw_path(picture, self.view(camera).pixels(points, width, height))
        return picture, how

    def camera_picture(self, camera: str, width: int, height: int) -> Picture:
        """Draw a picture fast: by OpenGL, where that works, and without shadows.

        Policies, recordings, the networks and agents have their pictures from here.
        """
        self._require_open()
        return self._draw(self.physics.snapshot, camera, *picture_size(width, height))

    def _draw(self, snapshot: Snapshot, camera: str, width: int = PICTURE[1], height: int = PICTURE[0]) -> Picture:
        try:
            return self._renderer.render(snapshot, camera, width, height, quality=False)
        except RenderingError:
            data = snapshot.data()
            return draw(snapshot.compiled, data, camera_view(snapshot.compiled, data, camera), width, height)

    def view(self, camera: str = OVERVIEW) -> CameraView:
        """Return the present view of ``camera``, which puts world points into a picture."""
        snapshot = self.physics.snapshot
        return camera_view(snapshot.compiled, snapshot.data(), camera)


def save_picture(picture: Picture, path: str | Path) -> Path:
    """Write an RGB picture (height, width, 3) in the format of the path's suffix."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(target)
    return target


def save_animation(frames: Sequence[Picture], path: str | Path, fps: float = 12.5) -> Path:
    """Write pictures of one size as an endless GIF; ``fps`` is from 1 to 50.

    Raises:
        ValidationError: no frames, or ``fps`` out of its domain.
    """
    if not frames:
        raise ValidationError("frames must hold at least one picture.")
    if not 1 <= fps <= 50:
        raise ValidationError(f"fps must be from 1 to 50, not {fps!r}.")
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # One palette for all frames: a palette each makes still parts flicker.
    sample = Image.fromarray(np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]]))
    palette = sample.quantize(colors=192, method=Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for f in frames]
    images[0].save(target, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0, optimize=True)
    return target


class Recording:
    """Frames of a motion with the gripper's path, taken by :meth:`capture`."""

    def __init__(
        self,
        world: PicturesMixin,
        *,
        camera: str = "overview",
        width: int = 480,
        height: int = 360,
        robot_name: str | None = None,
    ) -> None:
        self._world = world
        self._camera = camera
        self._size = (width, height)
        self._robot = robot_name
        self.frames: list[Picture] = []
        self.path: list[tuple[float, float, float]] = []
        self.how = ""

    def trace(self) -> None:
        """Add the gripper's place to the path; cheap enough for every control step."""
        self.path.append(self._world.tip_position(self._robot))

    def capture(self) -> None:
        """Take a frame, with the path so far drawn over it."""
        self.trace()
        frame, self.how = self._world.picture(self._camera, *self._size, path=self.path)
        self.frames.append(frame)

    def save_picture(self, path: str | Path, width: int = 960, height: int = 720) -> Path:
        """Write the present world, larger, with the whole path."""
        self.trace()
        picture, self.how = self._world.picture(self._camera, width, height, path=self.path)
        return save_picture(picture, path)

    def save_animation(self, path: str | Path, fps: float = 12.5) -> Path:
        """Write the captured frames as a GIF."""
        return save_animation(self.frames, path, fps)
