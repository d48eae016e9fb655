"""Tools for agents, loaded at first access; the package needs no extra."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.tools.robot_mesh import robot_mesh
    from strands_robots.tools.ros import use_ros, use_rosbridge, use_rtps

__all__ = ["robot_mesh", "use_ros", "use_rosbridge", "use_rtps"]


class _Tools(ModuleType):
    """This package, in which an import of a tool's module binds the tool."""

    def __setattr__(self, name: str, value: object) -> None:
        is_module = name in __all__ and isinstance(value, ModuleType)
        super().__setattr__(name, getattr(value, name) if is_module else value)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        return import_module("strands_robots.moved").moved_name(__name__, name)
    module = import_module(f"{__name__}.{'robot_mesh' if name == 'robot_mesh' else 'ros'}")
    tool = globals()[name] = getattr(module, name)
    return tool


sys.modules[__name__].__class__ = _Tools
