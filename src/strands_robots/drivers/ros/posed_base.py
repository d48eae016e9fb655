"""A mobile base that tells where it is."""

from __future__ import annotations

from typing import Any

from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.envelope import Envelope


class PosedBaseRobot(MobileBaseRobot):
    """A :class:`MobileBaseRobot` of a platform with odometry, whose topic can be read too."""

    def get_pose(self, timeout: float = 5.0) -> Envelope:
        """The next sample of the odometry topic, within ``timeout`` seconds, above 0."""
        return self._read("get_pose", "odom_topic", (self._odometry.topic, self._odom_kind), timeout)

    @property
    def reads(self) -> tuple[str, ...]:
        """The reads that this robot's topics allow: ``get_pose``, ``get_scan``."""
        return super().reads if self._odometry.topic is None else ("get_pose", *super().reads)

    @property
    def tools(self) -> list[Any]:
        """As of every base, with ``get_pose_<name>`` where it has an odometry topic."""
        from strands_robots.drivers.ros.tools import pose_tool  # noqa: PLC0415 - strands is loaded when it is used

        found = super().tools
        return found if self._odometry.topic is None else [*found, pose_tool(self)]
