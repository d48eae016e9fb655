"""A mobile base with a navigation stack as a device: ``navigateTo`` beside ``drive``."""

from __future__ import annotations

from typing import Any

from strands_robots.device_connect._compat import rpc
from strands_robots.device_connect.base_driver import Call
from strands_robots.device_connect.mobile_base_driver import MobileBaseDeviceDriver
from strands_robots.device_connect.robot_driver import DURATION_MAX_S
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.ros.gate import Approved
from strands_robots.utils import number, text


class NavigatingBaseDeviceDriver(MobileBaseDeviceDriver):
    """A mobile base with a navigation stack. Start it with drive or navigateTo, end it with stop.

    Args:
        robot: a base of :mod:`strands_robots.drivers.ros.ros_bridge` that was made with a ``nav_action``.
    """

    def __init__(self, robot: RosBridgedRobot, **options: Any) -> None:
        super().__init__(robot, **options)
        self._navigator = robot

    @rpc(labels={"direction": "write", "safety": "critical"})
    async def navigateTo(
        self,
        x: float,
        y: float,
        yaw: float = 0.0,
        frame_id: str = "map",
        timeout: float = 120.0,  # noqa: ASYNC109 - the goal's time, not this call's
    ) -> dict[str, Any]:
        """Send the base to a place around obstacles and return at once; follow it with getStatus or taskComplete.

        Args:
            x: Position of the goal in metres, along the frame's x axis
            y: Position of the goal in metres, along the frame's y axis
            yaw: Heading at the goal in radians; positive is to the left
            frame_id: Frame in which the goal is given, such as map or odom
            timeout: Seconds after which the goal is cancelled, above 0 and at most 3600
        """

        def prepare() -> Call:
            place = number("x", x), number("y", y), number("yaw", yaw)
            frame = text("frame_id", frame_id, longest=255)
            seconds = number("timeout", timeout, above=0, high=DURATION_MAX_S)
            # The operator's approval of this verb is the approval of the goal that it sends.
            return lambda: self._navigator.start_navigation(*place, frame, seconds, Approved())

        return await self.move("navigateTo", prepare)
