"""Pictures of a simulated world, with or without OpenGL, and files of motions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from strands_robots.simulation import rendering
from strands_robots.simulation.body import PICTURE
from strands_robots.simulation.physics import Physics, Snapshot
from strands_robots.simulation.rendering import (
    OVERVIEW,
    CameraView,
    Picture,
    Renderer,
    RenderingError,
    camera_view,
    draw_path,
    picture_size,
)
from strands_robots.utils import ValidationError, flag


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
        return rendering.draw(snapshot.compiled, data, camera_view(snapshot.compiled, data, camera), *size)

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
            return rendering.draw(snapshot.compiled, data, camera_view(snapshot.compiled, data, camera), width, height)

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
