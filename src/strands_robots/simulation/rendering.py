"""Pictures by MuJoCo's own renderer, off screen.

An OpenGL context belongs to one thread. Each world has one rendering thread that owns its contexts, started with
the first picture and ended by ``cleanup``; callers of any thread hand it work and wait. It draws from a snapshot
and its own copy of the data, so that it never holds up physics.
"""

from __future__ import annotations

import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.simulation import gl
from strands_robots.simulation.engine import BACKEND, mujoco
from strands_robots.simulation.physics import Snapshot
from strands_robots.simulation.stage import Stage
from strands_robots.simulation.views import CameraView, find_camera, look, pose

Picture = NDArray[np.uint8]

KEPT = 3
"""Contexts kept for different sizes and qualities; an older one is freed."""


class RenderingError(RuntimeError):
    """No picture by OpenGL on this machine; the message says what to install."""


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
        """An RGB picture (height, width, 3).

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
        pose(snapshot.stage, self._data, snapshot.qpos)
        view = look(snapshot.stage, self._data, camera)
        renderer.update_scene(self._data, _mujoco_camera(view))
        flags = renderer.scene.flags
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            flags[flag] = quality
        picture: Picture = renderer.render()
        return picture

    def _context(self, stage: Stage, width: int, height: int, quality: bool) -> Any:
        key = (width, height, quality)
        found = self._contexts.get(key)
        if found is not None:
            return found
        while len(self._contexts) >= KEPT:
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
            raise RenderingError(f"no OpenGL picture (MUJOCO_GL={BACKEND or 'unset'}: {why}); {gl.remedy()}.") from exc
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
