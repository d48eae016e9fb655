"""Cameras, and pictures by MuJoCo's own renderer, off screen.

An OpenGL context belongs to one thread. Each world has one rendering thread that owns its contexts, started with
the first picture and ended by ``cleanup``; callers of any thread submit work to it and wait. It draws from a snapshot
and its own copy of the data, so that it never delays physics.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from strands_robots.errors import StrandsRobotsError
from strands_robots.simulation.engine import BACKEND, mujoco, remedy
from strands_robots.simulation.model import MAX_HEIGHT, MAX_WIDTH, Floats, Stage
from strands_robots.simulation.physics import Snapshot
from strands_robots.utils import ValidationError, shown

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


def camera_names(stage: Stage) -> list[str]:
    """Return every camera that a picture can be taken with."""
    return [OVERVIEW, *(str(stage.model.camera(i).name) for i in range(stage.model.ncam))]


def find_camera(stage: Stage, name: object) -> str:
    """Return a camera's full name; its part without the robot is enough if unique.

    Raises:
        ValidationError: no such camera, or several robots have one of that name.
    """
    names = camera_names(stage)
    if isinstance(name, str):
        if name in names:
            return name
        ends = [n for n in names if n.endswith(f"/{name}")]
        if len(ends) == 1:
            return ends[0]
    raise ValidationError(f"camera must be one of {', '.join(names)}, not {shown(name)}.")


def camera_view(stage: Stage, data: Any, camera: object) -> CameraView:
    """Return the view of ``camera`` in ``data``. Raises as :func:`find_camera`."""
    name = find_camera(stage, camera)
    if name != OVERVIEW:
        index = stage.model.camera(name).id
        return CameraView(
            name,
            data.cam_xpos[index].copy(),
            data.cam_xmat[index].reshape(3, 3).copy(),
            float(stage.model.cam_fovy[index]),
        )
    lookat, distance = _fit(stage, data)
    azimuth, elevation = np.radians(AZIMUTH), np.radians(ELEVATION)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(right, forward), -forward], axis=1)
    fovy = float(stage.model.vis.global_.fovy)
    return CameraView(name, lookat - distance * forward, rotation, fovy, lookat, distance)


def _fit(stage: Stage, data: Any) -> tuple[Floats, float]:
    """Return the point and the distance from which every robot's reach is visible."""
    model = stage.model
    prefixes = tuple(f"{name}/" for name in stage.robots)
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
        self._stage: Stage | None = None
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
        name = find_camera(snapshot.stage, camera)
        return self._thread.submit(self._render, snapshot, name, width, height, quality).result()

    def close(self) -> None:
        """Free every context and end the thread."""
        self._thread.submit(_free, self._contexts).result()
        self._thread.shutdown()

    def _render(self, snapshot: Snapshot, camera: str, width: int, height: int, quality: bool) -> Picture:
        if self._stage is not snapshot.stage:
            _free(self._contexts)
            self._stage = snapshot.stage
            self._data = mujoco.MjData(snapshot.stage.model)
        renderer = self._context(snapshot.stage, width, height, quality)
        snapshot.pose(self._data)
        view = camera_view(snapshot.stage, self._data, camera)
        renderer.update_scene(self._data, _mujoco_camera(view))
        flags = renderer.scene.flags
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            flags[flag] = quality
        picture: Picture = renderer.render()
        return picture

    def _context(self, stage: Stage, width: int, height: int, quality: bool) -> Any:
        key = (width, height, quality)
        if key in self._contexts:
            return self._contexts[key]
        while len(self._contexts) >= _CONTEXTS_MAX:
            self._contexts.pop(next(iter(self._contexts))).close()
        visual = stage.model.vis
        visual.global_.offwidth, visual.global_.offheight = width, height
        visual.quality.shadowsize = 4096 if quality else 0
        visual.quality.offsamples = 8 if quality else 0
        try:
            self._contexts[key] = mujoco.Renderer(stage.model, height, width)
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
