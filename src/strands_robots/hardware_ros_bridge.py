"""Bridge of a real robot to a ROS 2 graph through rclpy: its joints and cameras, and joint commands for it."""

from __future__ import annotations

from strands_robots.ros_telemetry import RosTelemetryBridge


class HardwareRosBridge(RosTelemetryBridge):
    """Publishes joints and images, and forwards ``/<robot>/joint_command`` to ``robot.send_action``.

    Commands are taken as :class:`~strands_robots.ros_telemetry.RosTelemetryBase` describes. For the arguments see
    :class:`~strands_robots.ros_telemetry.RosTelemetryBridge`; the node is called ``strands_hardware`` by default.
    """

    default_node_name = "strands_hardware"
