"""A base's capabilities as Strands agent tools, each named by its robot."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

from strands_robots.agent_tool import ToolContext, tool

if TYPE_CHECKING:
    from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
    from strands_robots.drivers.ros.posed_base import PosedBaseRobot
    from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot


NAME_MAX = 55
"""Longest robot name in a tool's, which model APIs bound at 64 characters: the longest verb takes nine."""

_HASHED = 8


def suffix_of(node_name: str) -> str:
    """What a tool's name has of its robot's: the name itself where model APIs take it, else one that is as unique."""
    plain = node_name.replace(".", "_")
    if plain == node_name and len(plain) <= NAME_MAX:
        return plain
    digest = hashlib.sha256(node_name.encode()).hexdigest()[:_HASHED]
    return f"{plain[: NAME_MAX - _HASHED - 1]}_{digest}"


def tools_of(robot: MobileBaseRobot) -> list[Any]:
    """``drive_<name>``, ``stop_<name>``, ``status_<name>`` and, where the robot has a scanner, ``get_scan_<name>``.

    The tool's ``drive`` needs a duration, starts and returns, so that an agent can stop what it began.
    """
    name = suffix_of(robot.node_name)

    @tool(
        name=f"drive_{name}",
        description=f"Drive {robot.node_name} for some seconds; returns once it has begun. {robot.motion_note()}",
        context=True,
    )
    def drive(linear: float, angular: float, duration: float, tool_context: ToolContext) -> dict[str, Any]:
        """Drive.

        Args:
            linear: Speed forwards in m/s; negative reverses.
            angular: Turning rate in rad/s; positive turns left.
            duration: Seconds until the robot is stopped again, above 0.
        """
        return robot.start_drive(linear, angular, duration, tool_context)

    @tool(name=f"stop_{name}", description=f"Stop {robot.node_name} now; says whether it stands.")
    def stop() -> dict[str, Any]:
        """Stop."""
        return robot.stop()

    @tool(name=f"status_{name}", description=f"Whether {robot.node_name} is driving, and how its last drive ended.")
    def status() -> dict[str, Any]:
        """Tell the state."""
        return robot.get_task_status()

    @tool(name=f"get_scan_{name}", description=f"Read one laser scan of {robot.node_name}.")
    def get_scan(timeout: float = 5.0) -> dict[str, Any]:
        """Read a scan.

        Args:
            timeout: Seconds to wait for a sample, above 0.
        """
        return robot.get_scan(timeout)

    return [drive, stop, status, *([get_scan] if "get_scan" in robot.reads else [])]


def pose_tool(robot: PosedBaseRobot) -> Any:
    """``get_pose_<name>``: one sample of the robot's odometry."""

    @tool(
        name=f"get_pose_{suffix_of(robot.node_name)}", description=f"Read where {robot.node_name} is and how it moves."
    )
    def get_pose(timeout: float = 5.0) -> dict[str, Any]:
        """Read the pose.

        Args:
            timeout: Seconds to wait for a sample, above 0.
        """
        return robot.get_pose(timeout)

    return get_pose


def navigate_tool(robot: RosBridgedRobot) -> Any:
    """``navigate_<name>``: a goal for the robot's own navigation stack, waited for."""

    @tool(
        name=f"navigate_{suffix_of(robot.node_name)}",
        description=f"Let {robot.node_name} navigate to a place around obstacles; returns when it arrived or gave up.",
        context=True,
    )
    def navigate(  # noqa: PLR0917 - the goal's own parts
        x: float,
        y: float,
        tool_context: ToolContext,
        yaw: float = 0.0,
        frame_id: str = "map",
        timeout: float = 120.0,
    ) -> dict[str, Any]:
        """Navigate.

        Args:
            x: Position of the goal in metres, along the frame's x axis.
            y: Position of the goal in metres, along the frame's y axis.
            yaw: Heading at the goal in radians; positive is to the left.
            frame_id: Frame in which the goal is given, such as map or odom.
            timeout: Seconds after which the goal is cancelled, above 0.
        """
        return robot.navigate_to(x, y, yaw, frame_id, timeout, tool_context)

    return navigate
