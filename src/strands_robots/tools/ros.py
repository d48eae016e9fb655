"""Agent tools for a ROS graph: ``use_ros``, ``use_rtps`` and ``use_rosbridge``."""

from __future__ import annotations

from typing import Any

from strands_robots.agent_tool import ToolContext, fitted_tool
from strands_robots.ros.actions import ros_action
from strands_robots.utils import ValidationError, shown

NAMES = ("name", "topic", "service", "action_name")
"""Names of strands-robots 0.5 for the one argument that is called name here."""


COMMANDS = ("publish", "service_call", "action_goal")
TAKES = ("action", "tool_context", "name", "type", "fields", "count", "rate", "timeout")


def _renamed(given: dict[str, Any], *more: str) -> dict[str, Any]:
    """Return arguments by today's names; two names for one thing are refused as one.

    Args:
        given: as they came.
        more: the tool's arguments besides :data:`TAKES`.

    Raises:
        ValidationError: an argument that a command would not read.
    """
    named = list(dict.fromkeys(str(given[each]) for each in NAMES if given.get(each)))
    renamed = {key: value for key, value in given.items() if key not in NAMES}
    if named:
        renamed["name"] = " or ".join(named)
    if renamed.get("type", "") is None:
        del renamed["type"]
    if renamed.get("action") == "action_send_goal":
        renamed["action"] = "action_goal"
    takes = (*TAKES, *more)
    unknown = ", ".join(shown(key) for key in renamed if key not in takes)
    if unknown and renamed.get("action") in COMMANDS:
        raise ValidationError(f"{renamed['action']} takes {', '.join(takes[2:])}, not {unknown}.")
    return renamed


@fitted_tool(lambda given: _renamed(given, "domain_id"), context=True)
def use_ros(
    action: str,
    tool_context: ToolContext | None = None,
    *,
    name: str = "",
    type: str = "",  # noqa: A002 - ROS calls it so
    fields: dict[str, Any] | None = None,
    count: int = 1,
    rate: float = 10.0,
    timeout: float = 5.0,
    domain_id: int | None = None,
) -> dict[str, Any]:
    """Look at, read and write a ROS 2 graph. Commands that move a robot ask the operator.

    Args:
        action: status, list_topics, list_nodes, list_services, list_actions, info, echo, publish, service_call or
            action_goal; without a sourced ROS 2 topics alone.
        name: Topic, service or action, such as /odom.
        type: Its interface, such as geometry_msgs/msg/Twist; needed to publish, call or send a goal.
        fields: Fields of the message, request or goal; what is left out is zero.
        count: Messages to read or publish, 1 to 1000.
        rate: Messages a second when publishing several, above 0 and at most 100.
        timeout: Seconds to wait for each message, answer or end, above 0 and at most 600.
        domain_id: ROS 2 domain, 0 to 232; that of ROS_DOMAIN_ID when it is left out.
    """
    return ros_action(
        action,
        name=name,
        type=type or None,
        fields=fields,
        count=count,
        rate=rate,
        timeout=timeout,
        domain_id=domain_id,
        tool_context=tool_context,
    )


@fitted_tool(lambda given: _renamed(given, "domain_id"), context=True)
def use_rtps(
    action: str,
    tool_context: ToolContext | None = None,
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


@fitted_tool(lambda given: _renamed(given, "host", "port"), context=True)
def use_rosbridge(
    action: str,
    tool_context: ToolContext | None = None,
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
