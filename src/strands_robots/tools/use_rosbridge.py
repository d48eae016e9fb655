"""``use_rosbridge``: an agent's tool for the graph behind a rosbridge server."""

from __future__ import annotations

from typing import Any

from strands_robots.agent_tool import ToolContext, tool
from strands_robots.ros.actions import ros_action


@tool(context=True)
def use_rosbridge(
    action: str,
    tool_context: ToolContext,
    *,
    name: str = "",
    type: str = "",  # noqa: A002 - ROS calls it so
    fields: dict[str, Any] | None = None,
    count: int = 1,
    rate: float = 10.0,
    timeout: float = 5.0,
    host: str = "localhost",
    port: int = 9090,
) -> dict[str, Any]:
    """Look at, read and write the ROS graph behind a rosbridge server. Commands that move a robot ask the operator.

    Args:
        action: status, list_topics, list_nodes, list_services, list_actions, info, echo, publish, service_call or
            action_goal.
        name: Topic, service or action, such as /odom.
        type: Its interface, such as geometry_msgs/Twist; needed to publish, call or send a goal.
        fields: Fields of the message, request or goal; what is left out is zero.
        count: Messages to read or publish, 1 to 1000.
        rate: Messages a second when publishing several, above 0 and at most 100.
        timeout: Seconds to wait for each message, answer or end, above 0 and at most 600.
        host: Hostname or IP address of the rosbridge server.
        port: TCP port of the rosbridge server.
    """
    return ros_action(
        action,
        name=name,
        type=type or None,
        fields=fields,
        count=count,
        rate=rate,
        timeout=timeout,
        backend="rosbridge",
        host=host,
        port=port,
        tool_context=tool_context,
    )
