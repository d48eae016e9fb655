"""Names and types of a ROS graph: topics, services, actions and the interfaces they carry."""

from __future__ import annotations

import re
from functools import lru_cache

from strands_robots.utils import ValidationError, shown

NAME_MAX = 255
"""Longest graph name in characters, the bound of DDS topic names."""

_NAME = re.compile(r"[/~]?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_KIND = re.compile(r"([a-z][a-z0-9_]*)/(?:(?:msg|srv|action)/)?([A-Z][A-Za-z0-9]*)\Z")


def graph_name(name: str, value: object) -> str:
    """A topic, service or action: slash-separated words, each starting with a letter or an underscore."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _NAME.match(value) or "__" in value:
        raise ValidationError(
            f"{name} must be a ROS name of letters, digits, '_' and '/', such as /cmd_vel, not {shown(value)}."
        )
    return value


def interface(name: str, value: object) -> str:
    """An interface type: ``pkg/Name`` as ROS 1 writes it, or with ``msg``, ``srv`` or ``action`` in between."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _KIND.match(value):
        raise ValidationError(
            f"{name} must be a ROS type such as geometry_msgs/msg/Twist or geometry_msgs/Twist, not {shown(value)}."
        )
    return value


@lru_cache(maxsize=256)
def bare_kind(kind: str) -> str:
    """``pkg/Name`` of either spelling, so that types can be compared."""
    found = _KIND.match(kind)
    return f"{found[1]}/{found[2]}" if found else kind


def class_place(kind: str, section: str) -> tuple[str, str]:
    """Python module and class of an interface: ``section`` is msg, srv or action. Raises :class:`ValidationError`."""
    found = _KIND.match(kind)
    if found is None:
        raise ValidationError(f"type must be a ROS type such as geometry_msgs/msg/Twist, not {shown(kind)}.")
    return f"{found[1]}.{section}", found[2]


def node_name(name: str, value: object) -> str:
    """A node: letters, digits and underscores, the first no digit."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _NODE.match(value):
        raise ValidationError(
            f"{name} must be a ROS node name of letters, digits and '_', not starting with a digit, not {shown(value)}."
        )
    return value
