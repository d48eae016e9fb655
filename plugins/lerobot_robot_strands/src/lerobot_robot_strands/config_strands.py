"""Options ``--robot.…`` of a served robot."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("strands")
@dataclass(kw_only=True)
class StrandsRobotConfig(RobotConfig):  # type: ignore[misc]
    """A robot that ``strands-robots serve`` has on the network.

    Attributes:
        peer_id: its id there, such as ``arm-1``; a robot of a world of several is ``WORLD/ROBOT``.
        fleet: connection profile by which it is reached; empty for this machine, or what the environment names.
        camera_names: its cameras, as its ``listCameras`` has them; None for its own, an empty list for none.
        camera_width: largest width of a picture, in pixels.
        camera_height: largest height of a picture, in pixels.
        camera_fps: pictures a second that each camera is asked for, above 0.
        max_age_s: age of a reading or a picture beyond which the command ends.
        pause_s: silence of the command after which the robot is told to hold; until then it keeps its last target.
        max_hold_s: longest hold that the network causes, after which the command ends.
        max_speed: whole joint ranges a second that the robot may cross.
    """

    peer_id: str
    fleet: str = ""
    camera_names: list[str] | None = None
    camera_width: int = 640
    camera_height: int = 480
    camera_fps: float = 30.0
    max_age_s: float = 0.5
    pause_s: float = 0.25
    max_hold_s: float = 2.0
    max_speed: float = 2.0
