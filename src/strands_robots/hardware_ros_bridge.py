"""Bridge of a real robot to a ROS 2 graph through rclpy."""

from __future__ import annotations

from strands_robots.ros_telemetry import RosTelemetryBridge


class HardwareRosBridge(RosTelemetryBridge):
    """Publisher of joints and images that takes ``/<robot>/joint_command``.

    Commands are taken as :class:`~strands_robots.ros_telemetry.RosTelemetryBase` describes. For the arguments see
    :class:`~strands_robots.ros_telemetry.RosTelemetryBridge`; the node is called ``strands_hardware`` by default.
    """

    default_node_name = "strands_hardware"
