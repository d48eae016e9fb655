"""Keeping what was seen: a picture with the gripper's path, and a short animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

from strands_robots.simulation.rendering import Picture
from strands_robots.simulation.stage import Floats
from strands_robots.utils import ValidationError

if TYPE_CHECKING:
    from strands_robots.simulation.pictures import Pictures

_FINE = 3
"""Lines are drawn this many times larger and scaled down, so that they are smooth."""

_EARLY, _LATE = np.array([60, 120, 235]), np.array([235, 55, 95])


def draw_path(picture: Picture, points: Floats) -> Picture:
    """A copy of ``picture`` with a line through ``points`` (n, at least 2) in pixels: blue where it began, red at its
    end, a dot there. Points behind the camera (a third column of depth below zero) are left out."""
    shown = points if points.shape[1] < 3 else points[points[:, 2] > 0]
    height, width = picture.shape[:2]
    layer = Image.new("RGBA", (width * _FINE, height * _FINE), (0, 0, 0, 0))
    pen = ImageDraw.Draw(layer)
    thick = max(2, round(height * _FINE / 160))
    for index in range(len(shown) - 1):
        share = (index + 1) / max(1, len(shown) - 1)
        colour = tuple(int(v) for v in _EARLY * (1 - share) + _LATE * share)
        (x0, y0), (x1, y1) = shown[index][:2] * _FINE, shown[index + 1][:2] * _FINE
        pen.line((x0, y0, x1, y1), fill=(*colour, 235), width=thick)
        pen.ellipse((x1 - thick / 2, y1 - thick / 2, x1 + thick / 2, y1 + thick / 2), fill=(*colour, 235))
    if len(shown):
        x, y = shown[-1][:2] * _FINE
        pen.ellipse((x - 1.6 * thick, y - 1.6 * thick, x + 1.6 * thick, y + 1.6 * thick), fill=(255, 255, 255, 255))
        pen.ellipse((x - thick, y - thick, x + thick, y + thick), fill=(*(int(v) for v in _LATE), 255))
    layer = layer.resize((width, height), Image.Resampling.LANCZOS)
    return np.asarray(Image.alpha_composite(Image.fromarray(picture).convert("RGBA"), layer).convert("RGB")).copy()


def save_picture(picture: Picture, path: str | Path) -> Path:
    """Write an RGB picture (height, width, 3) as the kind that the path's suffix names."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(target)
    return target


def save_animation(frames: Sequence[Picture], path: str | Path, fps: float = 12.5) -> Path:
    """Write pictures of one size as an endless GIF. ``fps`` from 1 to 50: a GIF counts in hundredths of a second.

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
    """Frames and the gripper's path along a motion: :meth:`capture` as often as wanted, then save."""

    def __init__(
        self,
        world: Pictures,
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
        """Note where the gripper is, without a picture: cheap enough for every control step."""
        self.path.append(self._world.tip_position(self._robot))

    def capture(self) -> None:
        """Take a frame, with the path so far drawn over it."""
        self.trace()
        frame, self.how = self._world.picture(self._camera, *self._size, path=self.path)
        self.frames.append(frame)

    def save_picture(self, path: str | Path, width: int = 960, height: int = 720) -> Path:
        """The world as it is now, larger, with the whole path."""
        self.trace()
        picture, self.how = self._world.picture(self._camera, width, height, path=self.path)
        return save_picture(picture, path)

    def save_animation(self, path: str | Path, fps: float = 12.5) -> Path:
        """The captured frames as a GIF."""
        return save_animation(self.frames, path, fps)
