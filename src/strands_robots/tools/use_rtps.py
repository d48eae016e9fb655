"""``use_rtps``: an agent's tool for ROS 2 topics over bare DDS."""

from __future__ import annotations

from typing import Any

from strands_robots.agent_tool import ToolContext, tool
from strands_robots.ros.actions import ros_action


@tool(context=True)
def use_rtps(
    action: str,
    tool_context: ToolContext,
    *,
    name: str = "",
    type: str = "",  # noqa: A002 - ROS calls it so
    fields: dict[str, Any] | None = None,
    count: int = 1,
    rate: float = 10.0,
    timeout: float = 5.0,
    domain_id: int = 0,
) -> dict[str, Any]:
    """Look at, read and write ROS 2 topics over bare DDS. Commands that move a robot ask the operator.

    Args:
        action: status, list_topics, info, echo or publish; services and actions need use_ros or use_rosbridge.
        name: Topic, such as /odom.
        type: Its interface, such as geometry_msgs/msg/Twist; needed to publish.
        fields: Fields of the message; what is left out is zero.
        count: Messages to read or publish, 1 to 1000.
        rate: Messages a second when publishing several, above 0 and at most 100.
        timeout: Seconds to wait for each message, above 0 and at most 600.
        domain_id: ROS 2 domain, 0 to 232.
    """
    return ros_action(
        action,
        name=name,
        type=type or None,
        fields=fields,
        count=count,
        rate=rate,
        timeout=timeout,
        backend="dds",
        domain_id=domain_id,
        tool_context=tool_context,
    )
