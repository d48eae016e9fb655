"""What every bridge of a joint robot to ROS shares: its topics, its refusals, and the way of a joint command."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from typing import Any

from strands_robots.envelope import is_error, text_of
from strands_robots.utils import ValidationError, flag, number, shown, text, whole

logger = logging.getLogger(__name__)

DOMAIN_MAX = 232
JOINT_STATE = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"

Limits = dict[str, tuple[float, float]]


def segment(name: str) -> str:
    """One word of a topic's name, made of whatever a robot or camera is called."""
    word = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "robot"
    return f"_{word}" if word[0].isdigit() else word


def checked_limits(limits: object) -> Limits:
    """``{"<motor>.pos": (min, max)}`` of finite numbers. Raises :class:`ValidationError` naming the joint."""
    if limits is None:
        return {}
    if not isinstance(limits, dict):
        raise ValidationError(f"joint_limits must be an object of (min, max) pairs by joint, not {shown(limits)}.")
    checked: Limits = {}
    for joint, pair in limits.items():
        where = f"joint_limits[{shown(joint)}]"
        if not isinstance(joint, str) or not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValidationError(f"{where} must be a (min, max) pair by a joint's name, not {shown(pair)}.")
        low, high = number(f"{where} min", pair[0]), number(f"{where} max", pair[1])
        if low > high:
            raise ValidationError(f"{where} must have its min at most its max, not {low:g} and {high:g}.")
        checked[joint] = (low, high)
    return checked


class RosTelemetryBase:
    """The transport-independent half of a bridge.

    Args:
        robot: drives on inbound commands by its ``send_action``; None for a bridge that only publishes.
        domain_id: ROS 2 domain, 0 to 232.
        enable_commands: whether inbound commands are taken at all.
        command_robot_name: whose ``joint_command`` is taken; the robot's own name by default.
        period: seconds between two looks for a command, above 0; ``period_name`` is the caller's word for it.

    Raises:
        ValidationError: an argument outside its domain, before anything else has happened.
    """

    def __init__(
        self,
        robot: Any,
        *,
        domain_id: int,
        enable_commands: bool,
        command_robot_name: str | None,
        period: float,
        period_name: str,
    ) -> None:
        self._takes_commands = flag("enable_commands", enable_commands) and robot is not None
        self.domain_id = whole("domain_id", domain_id, low=0, high=DOMAIN_MAX)
        self._period_s = number(period_name, period, above=0)
        if command_robot_name is not None:
            command_robot_name = text("command_robot_name", command_robot_name, longest=128)
        self._robot = robot
        own = str(getattr(robot, "tool_name_str", "") or "robot")
        self.command_topic = f"/{segment(own if command_robot_name is None else command_robot_name)}/joint_command"
        self._limits: Limits = {}

    @staticmethod
    def joint_states_topic(robot: str) -> str:
        """Where a robot's joints are told."""
        return f"/{segment(robot)}/joint_states"

    @staticmethod
    def image_topic(robot: str, camera: str) -> str:
        """Where a camera's pictures are told."""
        return f"/{segment(robot)}/{segment(camera)}/image_raw"

    def command_error(self, names: Sequence[Any], positions: Sequence[Any]) -> str | None:
        """Why a joint command is dropped whole, or None."""
        if not names or len(names) != len(positions):
            return f"{len(names)} names and {len(positions)} positions"
        if len(set(names)) != len(names):
            return "a joint is named twice"
        for name, position in zip(names, positions, strict=True):
            try:
                value = number(str(name), position)
            except ValidationError as exc:
                return str(exc)
            low, high = self._limits.get(str(name), (value, value))
            if not low <= value <= high:
                return f"{name} must be from {low:g} to {high:g}, not {value:g}"
        return None

    def apply(self, command: Mapping[str, Any]) -> bool:
        """Hand a ``JointState`` as a command to the robot, whole or not at all; whether the robot took it."""
        names, positions = list(command.get("name", ())), list(command.get("position", ()))
        problem = self.command_error(names, positions)
        if problem is not None:
            logger.warning("A command on %s is dropped whole: %s.", self.command_topic, problem)
            return False
        try:
            # The robot's own verb asks its own gate: a locked robot refuses here as on every other road.
            answer = self._robot.send_action({str(n): float(p) for n, p in zip(names, positions, strict=True)})
        except Exception:
            logger.exception("%s did not take a command.", self.command_topic)
            return False
        if is_error(answer):
            logger.warning("%s was refused: %s", self.command_topic, text_of(answer))
            return False
        return True
