"""Real robots: the robot contract over any device with LeRobot's robot interface."""

from __future__ import annotations

from strands_robots.hardware.body import DeviceBody, LeaderArm
from strands_robots.hardware.robot import HardwareRobot

__all__ = ["DeviceBody", "HardwareRobot", "LeaderArm"]
