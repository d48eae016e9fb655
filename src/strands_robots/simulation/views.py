"""Where a camera stands: named cameras of the model, and the overview that fits the robots that are there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.stage import Floats, Stage
from strands_robots.utils import ValidationError, shown

OVERVIEW = "overview"
AZIMUTH, ELEVATION = 128.0, -20.0
"""Where the overview looks from, in degrees, as MuJoCo's free camera counts them."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """A camera: ``position`` in metres, ``rotation`` with its right, up and backward axes as columns, ``fovy`` in
    degrees of the picture's height. ``lookat`` and ``distance`` are those of the overview, else None and 0."""

    camera: str
    position: Floats
    rotation: Floats
    fovy: float
    lookat: Floats | None = None
    distance: float = 0.0

    def pixels(self, points: Iterable[Iterable[float]], width: int, height: int) -> Floats:
        """World points (n, 3) in metres to picture coordinates (n, 3): x right, y down, depth in metres."""
        local = (np.array([list(p) for p in points], dtype=np.float64).reshape(-1, 3) - self.position) @ self.rotation
        depth = -local[:, 2]
        scale = height / 2 / np.tan(np.radians(self.fovy) / 2)
        safe = np.maximum(depth, 1e-6)
        return np.stack(
            [width / 2 + scale * local[:, 0] / safe, height / 2 - scale * local[:, 1] / safe, depth], axis=1
        )


def camera_names(stage: Stage) -> list[str]:
    """Every camera a picture can be taken with."""
    return [OVERVIEW, *(str(stage.model.camera(i).name) for i in range(stage.model.ncam))]


def find_camera(stage: Stage, name: object) -> str:
    """The camera's full name; the robot's own part of it is enough where only one robot has it.

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


def look(stage: Stage, data: Any, name: str) -> CameraView:
    """The view of ``name`` (a full name) in the pose that ``data`` holds."""
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
    return CameraView(
        name, lookat - distance * forward, rotation, float(stage.model.vis.global_.fovy), lookat, distance
    )


def _fit(stage: Stage, data: Any) -> tuple[Floats, float]:
    """A point and a distance from which every robot and its reach are seen."""
    model = stage.model
    prefixes = tuple(f"{name}/" for name in stage.robots)
    bodies = [i for i in range(model.nbody) if prefixes and model.body(i).name.startswith(prefixes)]
    if not bodies:
        return np.array([0.15, 0.0, 0.1]), 1.0
    spots = data.xpos[bodies]
    # The bodies nearest the floor stay put while the arms swing: centring on the feet keeps the picture still.
    feet = np.array([data.xpos[model.body_rootid[i]] for i in bodies])
    low, high = feet.min(axis=0), feet.max(axis=0)
    spread = float(np.linalg.norm(high - low))
    tallest = float(min(max(spots[:, 2].max(), 0.1), 1.0))
    centre = (low + high) / 2 + np.array([0.11, 0.0, 0.0])
    return np.array([centre[0], centre[1], 0.13 if tallest > 0.15 else 0.06]), 0.95 + 0.85 * spread


def pose(stage: Stage, data: Any, qpos: Floats) -> None:
    """Put ``qpos`` into ``data`` and compute what pictures need; physics' own data is not touched."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(stage.model, data)
    mujoco.mj_comPos(stage.model, data)
    mujoco.mj_camlight(stage.model, data)
