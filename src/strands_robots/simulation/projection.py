"""A software picture of a world, without OpenGL: shaded faces through a depth buffer, in numpy alone.

Good for machines that have no OpenGL at all; slower than it and plainer: one light, its shadow on the floor, flat
faces. Every primitive and mesh is drawn, textures other than the floor's are not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.simulation.solids import Face, faces_of
from strands_robots.simulation.stage import Floats, Stage
from strands_robots.simulation.views import CameraView

Pixels = NDArray[np.float32]

_LIGHT = np.array([0.42, -0.42, 0.80]) / np.linalg.norm([0.42, -0.42, 0.80])
_SKY_TOP, _SKY_LOW = np.array([[150, 178, 208], [233, 238, 244]], dtype=np.float32)
_TILE_M = 0.1
_TILE_A, _TILE_B, _SEAM = np.array([[206, 211, 218], [197, 203, 212], [178, 186, 196]], dtype=np.float32)
_SHADOW_CELL_M = 0.004
_FINE = 2
"""Drawn this many times larger and averaged: anti-aliasing."""


def draw(stage: Stage, data: Any, view: CameraView, width: int, height: int) -> NDArray[np.uint8]:
    """The picture (height, width, 3) that ``view`` has of the pose in ``data``."""
    wide, high = width * _FINE, height * _FINE
    faces, floor = faces_of(stage, data)
    image, depth = _background(view, wide, high, faces if floor else None)
    for face in faces:
        _fill(image, depth, face, view)
    fine = np.clip(image, 0, 255).reshape(height, _FINE, width, _FINE, 3)
    picture: NDArray[np.uint8] = fine.mean(axis=(1, 3)).astype(np.uint8)
    return picture


def _fill(image: Pixels, depth: Pixels, face: Face, view: CameraView) -> None:
    """Draw one convex face where it is nearer than what is there."""
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
    near = depth[y0:y1, x0:x1]
    visible = inside & (inverse > near)
    near[visible] = inverse[visible]
    image[y0:y1, x0:x1][visible] = _shade(face, towards)


def _shade(face: Face, towards: Floats) -> Floats:
    lit = max(0.0, float(face.normal @ _LIGHT))
    sky = 0.5 + 0.5 * float(face.normal[2])
    half = _LIGHT + towards / np.linalg.norm(towards)
    gloss = max(0.0, float(face.normal @ half) / float(np.linalg.norm(half))) ** 24
    return face.colour * (0.30 + 0.16 * sky + 0.58 * lit) + 255.0 * 0.18 * face.shine * gloss * (lit > 0)


def _background(view: CameraView, wide: int, high: int, shadow_of: list[Face] | None) -> tuple[Pixels, Pixels]:
    """Sky, and the tiled floor with its shadows where there is one; the depth buffer holds one over depth."""
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
    # Above the first row that meets the floor there is sky alone: nothing to compute.
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
    """The floor's colours at points (m), seen from ``reach`` metres: a seam narrower than a pixel would flicker in
    the distance, so it fades with it."""
    u, v = x / np.float32(_TILE_M), y / np.float32(_TILE_M)
    column, row = np.floor(u), np.floor(v)
    seam = np.maximum(np.abs(u - column - 0.5), np.abs(v - row - 0.5)) > 0.485
    strength = (np.clip(1.2 - reach / 1.2, 0, 1) * seam)[..., None]
    odd = ((column + row) % 2 < 1)[..., None]
    tiles: Pixels = np.where(odd, _TILE_A, _TILE_B) * (1 - strength) + _SEAM * strength
    return tiles


def _shadow(faces: list[Face], x: Pixels, y: Pixels) -> Pixels:
    """How much of the light is kept from each floor point: the faces laid down along the light, with a soft edge."""
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
    """Fill one convex polygon, given in cells, whichever way round it is."""
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
