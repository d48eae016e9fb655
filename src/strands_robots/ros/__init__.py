"""ROS graphs: names, the command gate, and links that are loaded when used."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from strands_robots.moved import moved_name

if TYPE_CHECKING:
    from strands_robots.ros.actions import ros_action

__all__ = ["ros_action"]


def __getattr__(name: str) -> Any:
    if name == "ros_action":
        from strands_robots.ros.actions import ros_action  # noqa: PLC0415 - the package loads nothing by itself

        return ros_action
    return moved_name(__name__, name)
