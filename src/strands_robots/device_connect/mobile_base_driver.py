"""A mobile base as a device: ``drive`` beside what every robot answers."""

from __future__ import annotations

from typing import Any, ClassVar

from strands_robots.device_connect._compat import Labels, rpc
from strands_robots.device_connect.base_driver import Call
from strands_robots.device_connect.robot_driver import DURATION_MAX_S, RobotDeviceDriver
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.ros.gate import Approved
from strands_robots.utils import number


class MobileBaseDeviceDriver(RobotDeviceDriver):
    """A mobile base. Start it with drive, end it with stop.

    Args:
        robot: a base of :mod:`strands_robots.drivers.ros`.
    """

    labels: ClassVar[Labels] = {"category": "mobile_base"}

    def __init__(self, robot: MobileBaseRobot, **options: Any) -> None:
        super().__init__(robot, **options)
        self._base = robot

    @rpc(labels={"direction": "write", "safety": "critical"})
    async def drive(self, linear: float, angular: float, duration: float) -> dict[str, Any]:
        """Drive for some seconds and return at once; follow it with getStatus or the taskComplete event.

        Args:
            linear: Speed forwards in m/s; negative reverses
            angular: Turning rate in rad/s; positive turns left
            duration: Seconds until the base is stopped again, above 0 and at most 3600
        """

        def prepare() -> Call:
            speeds = number("linear", linear), number("angular", angular)
            seconds = number("duration", duration, above=0, high=DURATION_MAX_S)
            # The operator's approval of this verb is the approval of the commands that it sends.
            return lambda: self._base.start_drive(*speeds, seconds, Approved())

        return await self.move("drive", prepare)
