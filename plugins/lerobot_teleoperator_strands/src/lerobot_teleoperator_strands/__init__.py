"""A served robot whose joints lead another one, as a teleoperator of LeRobot's commands."""

from lerobot_teleoperator_strands.config_strands import StrandsTeleoperatorConfig
from lerobot_teleoperator_strands.teleoperator import StrandsTeleoperator

__all__ = ["StrandsTeleoperator", "StrandsTeleoperatorConfig"]
