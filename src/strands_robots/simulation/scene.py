"""Files of a motion: a picture with the gripper's path, and a short animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from strands_robots.simulation.rendering import Picture
from strands_robots.simulation.world import Simulation
from strands_robots.utils import ValidationError


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
        world: Simulation,
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
