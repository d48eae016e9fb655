"""A real robot's joints and cameras on a ROS 2 graph, and its joint commands from it, through rclpy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.ros_telemetry import RosTelemetryBridge


def lacking_security() -> str | None:
    """Why the graph that rclpy joins is not secured, a sentence, or None: it is.

    ROS 2 compares the two words letter by letter and falls back to an open graph on any other, so this does too.
    """
    if settings.verbatim("ROS_SECURITY_ENABLE") != "true":
        return "ROS_SECURITY_ENABLE is not true."
    if settings.verbatim("ROS_SECURITY_STRATEGY") != "Enforce":
        return "ROS_SECURITY_STRATEGY is not Enforce."
    keystore = settings.verbatim("ROS_SECURITY_KEYSTORE")
    if not keystore or not Path(keystore).is_dir():
        return "ROS_SECURITY_KEYSTORE names no folder."
    return None


class HardwareRosBridge(RosTelemetryBridge):
    """Publishes joints and images, and forwards ``/<robot>/joint_command`` to ``robot.send_action``.

    Commands are taken as :class:`~strands_robots.ros_telemetry.RosTelemetryBase` says.

    Args:
        robot: the robot to drive; None for a bridge that only publishes.
        domain_id: ROS 2 domain, 0 to 232.
        node_name: of the node, ``strands_hardware`` by default.
        qos_depth: KEEP_LAST history of each endpoint, 1 to ``MAX_QOS_HISTORY_DEPTH``.
        enable_commands: take commands, which needs a secured graph or the explicit opt-out.
        command_robot_name: whose command topic is taken; the robot's own name by default.
        spin_period: seconds between two looks for a command, above 0.
        joint_limits: ``{"<motor>.pos": (min, max)}`` in the robot's unit; what is not named is not limited here.

    Raises:
        ValidationError: an argument outside its domain, or commands on a graph that nobody secured; no node was made.
        RosError: no ROS 2 is sourced, or it did not start.
    """

    default_node_name = "strands_hardware"

    def __init__(
        self,
        robot: Any = None,
        *,
        domain_id: int = 0,
        node_name: str | None = None,
        qos_depth: int = 10,
        enable_commands: bool = True,
        command_robot_name: str | None = None,
        spin_period: float = 0.02,
        joint_limits: dict[str, tuple[float, float]] | None = None,
    ) -> None:
        super().__init__(
            robot,
            domain_id=domain_id,
            node_name=node_name,
            qos_depth=qos_depth,
            enable_commands=enable_commands,
            command_robot_name=command_robot_name,
            spin_period=spin_period,
            joint_limits=joint_limits,
        )

    def lacking_security(self) -> str | None:
        return lacking_security()

    def shutdown(self) -> None:
        """Take no more commands, then take the node off the graph. A second call does nothing."""
        super().shutdown()
