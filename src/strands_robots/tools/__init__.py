"""Tools for agents, loaded at first access; the package needs no extra."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.tools.robot_mesh import robot_mesh
    from strands_robots.tools.ros import use_ros, use_rosbridge, use_rtps

__all__ = ["robot_mesh", "use_ros", "use_rosbridge", "use_rtps"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        return import_module("strands_robots.moved").moved_name(__name__, name)
    # `robot_mesh` replaces the module of the same name, which the import has just bound here.
    module = import_module(f"{__name__}.{'robot_mesh' if name == 'robot_mesh' else 'ros'}")
    tool = globals()[name] = getattr(module, name)
    return tool
