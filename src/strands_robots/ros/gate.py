"""Command gate of a ROS graph: asks the operator before a robot is moved.

A surface is known by a word of its name, such as ``cmd_vel`` in ``/turtle1/cmd_vel``, or by its interface type,
whatever it is called. The order is: not gated; ``STRANDS_ROS2_COMMAND_ALLOW``; ``BYPASS_TOOL_CONSENT``; the
operator, asked through the agent's tool context; refused. What a message holds plays no part: zeros mean a
standing base on one topic and the zero pose on another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Any

from strands_robots import settings
from strands_robots.envelope import Envelope, error
from strands_robots.ros.link import bare_kind

ALLOW = "STRANDS_ROS2_COMMAND_ALLOW"

SURFACES = frozenset(
    {
        "cmd_vel",
        "cmd_vel_unstamped",
        "joint_command",
        "joint_commands",
        "joint_trajectory",
        "follow_joint_trajectory",
        "gripper_cmd",
        "manual_drive",
        "servo_msg",
        "vehicle_state",
        "enable_state",
        "navigate_to_pose",
        "navigate_through_poses",
        "follow_path",
        "follow_waypoints",
        "drive_on_heading",
        "spin",
        "backup",
        "move_base",
        "move_base_simple",
        "commands",
        "goal_pose",
        "initialpose",
        "enable_motors",
        "motor_enable",
        "motor_power",
        "set_motor_power",
        "torque_enable",
        "set_torque",
        "set_mode",
        "arming",
        "takeoff",
        "switch_controller",
    }
)
"""Name parts of a command surface: velocity and joint commands, goals, modes and motor enables."""

COMMAND_KINDS = {
    "geometry_msgs/Twist": "cmd_vel",
    "geometry_msgs/TwistStamped": "cmd_vel",
    "ackermann_msgs/AckermannDrive": "cmd_vel",
    "ackermann_msgs/AckermannDriveStamped": "cmd_vel",
    "deepracer_interfaces_pkg/ServoCtrlMsg": "manual_drive",
    "trajectory_msgs/JointTrajectory": "joint_trajectory",
    "control_msgs/FollowJointTrajectory": "follow_joint_trajectory",
    "nav2_msgs/NavigateToPose": "navigate_to_pose",
    "nav2_msgs/FollowPath": "follow_path",
}
"""Types that only motion commands have, with the surface that they stand for."""

_SUFFIXES = ("joint_commands", "joint_command", "joint_trajectory")
"""Surfaces that may have a prefix, such as that of one of two arms: left_joint_command."""

_YES = frozenset({"y", "yes", "a", "approve", "approved", "true"})


@lru_cache(maxsize=256)
def surface_of(name: str, kind: str | None = None) -> str | None:
    """Return the command surface of a graph name or type, or None: it is none."""
    for word in reversed(name.lower().strip("/~").split("/")):
        if word in SURFACES:
            return word
        if "cmd_vel" in word:
            return "cmd_vel"
        for suffix in _SUFFIXES:
            if word.endswith(suffix):
                return suffix
    return COMMAND_KINDS.get(bare_kind(kind)) if kind else None


class CommandGate:
    """Approval of single commands on a ROS graph.

    Args:
        read_list: gives the list of a setting by its name.
        bypass: True while the operator approves every command.
    """

    def __init__(
        self,
        read_list: Callable[[str], Sequence[str]] = settings.items,
        bypass: Callable[[], bool] = lambda: settings.boolean("BYPASS_TOOL_CONSENT"),
    ) -> None:
        self._read = read_list
        self._bypass = bypass

    def refusal(self, name: str, kind: str | None, what: str, tool_context: Any = None) -> Envelope | None:
        """Return the refusal of ``what`` on ``name``, or None.

        The framework's interrupt asks the operator: it leaves the tool by an exception and runs it again with the
        answer. So call this before any side effect.
        """
        surface = surface_of(name, kind)
        if surface is None or self._listed(name, surface) or self._bypass():
            return None
        ask = getattr(tool_context, "interrupt", None)
        if callable(ask):
            reason = {"command": what, "surface": surface, "name": name, "answer": "yes approves it once"}
            answer = ask(f"ros_command:{name}", reason=reason)
            if answer is True or (isinstance(answer, str) and answer.strip().lower() in _YES):
                return None
            return error(f"The operator did not approve {what} on {name}.", surface=surface)
        return error(
            f"{what} on {name} is a {surface} command and needs operator approval: add {surface} or {name} to {ALLOW}, "
            "or call it as an agent's tool, which asks the operator.",
            surface=surface,
        )

    def _listed(self, name: str, surface: str) -> bool:
        wanted = name if name.startswith("/") else f"/{name}"
        return any(entry == surface or fnmatchcase(wanted, entry) for entry in self._read(ALLOW))


class Approved:
    """Stand-in for the operator where a network has already asked for approval."""

    def interrupt(self, name: str, reason: Any = None) -> bool:
        """Approve the command."""
        del name, reason
        return True
