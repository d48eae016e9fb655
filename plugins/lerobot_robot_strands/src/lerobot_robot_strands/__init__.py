"""A robot that strands-robots serves, as a robot of LeRobot's commands."""

from lerobot_robot_strands.config_strands import StrandsRobotConfig
from lerobot_robot_strands.robot import StrandsRobot

__all__ = ["StrandsRobot", "StrandsRobotConfig"]
