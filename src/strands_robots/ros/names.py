"""Names, interface types and domains of a ROS graph."""

from __future__ import annotations

import re
from functools import lru_cache

from strands_robots import settings
from strands_robots.utils import ValidationError, shown, whole

NAME_MAX = 255
"""Longest graph name in characters, the bound of DDS topic names."""

DOMAIN_MAX = 232
"""Highest DDS domain: RTPS derives its UDP ports from it, and those of 233 are past 65535."""

LATCHED = ("/robot_description", "/map", "/tf_static")
"""Topics whose publishers keep their last message for a late subscription, by the conventions of ROS 2."""

_NAME = re.compile(r"[/~]?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_KIND = re.compile(r"([a-z][a-z0-9_]*)/(?:(?:msg|srv|action)/)?([A-Z][A-Za-z0-9]*)\Z")


def graph_name(name: str, value: object) -> str:
    """Check the name of a topic, service or action, such as /cmd_vel."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _NAME.match(value) or "__" in value:
        raise ValidationError(
            f"{name} must be a ROS name of letters, digits, '_' and '/', such as /cmd_vel, not {shown(value)}."
        )
    return value


def interface(name: str, value: object) -> str:
    """Check an interface type: ``pkg/Name`` (ROS 1) or ``pkg/msg/Name`` (ROS 2)."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _KIND.match(value):
        raise ValidationError(
            f"{name} must be a ROS type such as geometry_msgs/msg/Twist or geometry_msgs/Twist, not {shown(value)}."
        )
    return value


def is_latched(topic: str) -> bool:
    """Return True for a latched topic, by its name in any namespace."""
    return any(absolute(topic).endswith(name) for name in LATCHED)


@lru_cache(maxsize=256)
def bare_kind(kind: str) -> str:
    """Return ``pkg/Name`` for either spelling, so that types can be compared."""
    found = _KIND.match(kind)
    return f"{found[1]}/{found[2]}" if found else kind


def class_place(kind: str, section: str) -> tuple[str, str]:
    """Return module and class of an interface; ``section``: msg, srv or action.

    Raises:
        ValidationError: ``kind`` is no interface type.
    """
    found = _KIND.match(kind)
    if found is None:
        raise ValidationError(f"type must be a ROS type such as geometry_msgs/msg/Twist, not {shown(kind)}.")
    return f"{found[1]}.{section}", found[2]


def node_name(name: str, value: object) -> str:
    """Check the name of a node: letters, digits and underscores, the first no digit."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _NODE.match(value):
        raise ValidationError(
            f"{name} must be a ROS node name of letters, digits and '_', not starting with a digit, not {shown(value)}."
        )
    return value


def domain(domain_id: int | None) -> int:
    """Check a DDS domain, 0 to :data:`DOMAIN_MAX`; None stands for ``ROS_DOMAIN_ID``."""
    stated = settings.integer("ROS_DOMAIN_ID") if domain_id is None else domain_id
    return whole("domain_id", stated, low=0, high=DOMAIN_MAX)


def absolute(name: str) -> str:
    """Return a graph name with its leading slash; a private ``~`` name stays."""
    return name if name.startswith(("/", "~")) else f"/{name}"
