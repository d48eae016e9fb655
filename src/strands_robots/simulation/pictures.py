"""Pictures of a simulated world, by OpenGL or without it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from strands_robots.simulation import projection
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
from strands_robots.utils import flag


class PicturesMixin:
    """Pictures of a world that has the members declared here."""

    has_cameras = True
    """Every world has an overview."""

    physics: Physics
    _renderer: Renderer

    def _require_open(self) -> None:
        """Raise :class:`ValidationError` once the world was cleaned up."""
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
        return projection.draw(snapshot.stage, data, camera_view(snapshot.stage, data, camera), *size)

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
            return projection.draw(snapshot.stage, data, camera_view(snapshot.stage, data, camera), width, height)

    def view(self, camera: str = OVERVIEW) -> CameraView:
        """Return the present view of ``camera``, which puts world points into a picture."""
        snapshot = self.physics.snapshot
        return camera_view(snapshot.stage, snapshot.data(), camera)
