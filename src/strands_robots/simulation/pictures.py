"""What a world looks like: OpenGL where it works, a software projection where it does not."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from strands_robots.simulation import projection
from strands_robots.simulation.arguments import pixels
from strands_robots.simulation.backdrop import MAX_HEIGHT, MAX_WIDTH
from strands_robots.simulation.construction import Construction
from strands_robots.simulation.engine import mujoco
from strands_robots.simulation.rendering import Picture, Renderer, RenderingError
from strands_robots.simulation.scene import draw_path
from strands_robots.simulation.stage import Plan
from strands_robots.simulation.views import OVERVIEW, CameraView, find_camera, look, pose
from strands_robots.utils import ValidationError, flag

How = Literal["opengl", "projection"]


class Pictures(Construction):
    """The verbs that look. Each draws the latest snapshot and holds nothing up."""

    def __init__(self, plan: Plan, *, realtime: bool) -> None:
        super().__init__(plan, realtime=realtime)
        self._renderer: Renderer | None = None

    def render(self, camera: str = OVERVIEW, width: int = 320, height: int = 240, *, quality: bool = False) -> Picture:
        """A picture by OpenGL: RGB, (height, width, 3), unsigned bytes.

        Args:
            camera: overview, front, side, top, or a robot's own (``wrist``, or ``arm/wrist`` where several have one).
            width: 16 to 1920 pixels.
            height: 16 to 1440 pixels.
            quality: with shadows and anti-aliasing, at many times the cost in software.

        Raises:
            ValidationError: an argument outside its domain.
            RenderingError: OpenGL does not work on this machine; the message says which package is missing.
        """
        size = pixels("width", width, MAX_WIDTH), pixels("height", height, MAX_HEIGHT)
        nice = flag("quality", quality)
        with self.starting:
            self._open()
            if self._renderer is None:
                self._renderer = Renderer()
            renderer = self._renderer
        return renderer.render(self._physics.snapshot, camera, *size, quality=nice)

    def project(self, camera: str = OVERVIEW, width: int = 320, height: int = 240) -> Picture:
        """The same picture computed without OpenGL; arguments as for :meth:`render`."""
        size = pixels("width", width, MAX_WIDTH), pixels("height", height, MAX_HEIGHT)
        snapshot = self._physics.snapshot
        data = mujoco.MjData(snapshot.stage.model)
        pose(snapshot.stage, data, snapshot.qpos)
        return projection.draw(
            snapshot.stage, data, look(snapshot.stage, data, find_camera(snapshot.stage, camera)), *size
        )

    def picture(
        self,
        camera: str = OVERVIEW,
        width: int = 640,
        height: int = 480,
        *,
        path: Iterable[tuple[float, float, float]] = (),
    ) -> tuple[Picture, How]:
        """The best picture this machine can make, and how it was made; ``path`` (metres) is drawn over it."""
        how: How = "opengl"
        try:
            picture = self.render(camera, width, height, quality=True)
        except RenderingError:
            how, picture = "projection", self.project(camera, width, height)
        points = list(path)
        if points:
            picture = draw_path(picture, self.view(camera).pixels(points, width, height))
        return picture, how

    def view(self, camera: str = OVERVIEW) -> CameraView:
        """Where ``camera`` stands at this moment, to put world points into a picture."""
        snapshot = self._physics.snapshot
        data = mujoco.MjData(snapshot.stage.model)
        pose(snapshot.stage, data, snapshot.qpos)
        return look(snapshot.stage, data, find_camera(snapshot.stage, camera))

    def tip_position(self, robot_name: str | None = None) -> tuple[float, float, float]:
        """Where the robot's gripper tip is in the world, metres; its base where it has no gripper.

        Raises:
            ValidationError: no such robot.
        """
        name = self.body(robot_name).name
        snapshot = self._physics.snapshot
        parts = snapshot.stage.robots.get(name)
        if parts is None:
            raise ValidationError(f"robot {name} is not in the world any more.")
        data = mujoco.MjData(snapshot.stage.model)
        pose(snapshot.stage, data, snapshot.qpos)
        x, y, z = data.site(parts.tip).xpos if parts.tip else data.body(parts.root).xpos
        return float(x), float(y), float(z)

    def _close_pictures(self) -> None:
        with self.starting:
            renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()
