"""The calling side: robots on other machines, of Device Connect and of the mesh.

::

    from strands_robots import connect

    with connect() as fleet:                    # this machine, or the environment's network
        arm = fleet["arm-1"]                    # a RemoteRobot, whichever network it is on
        arm.move_to(x=0.25, y=0.0, z=0.1)       # its verbs are methods; help(arm.move_to) describes one
        with arm.control():
            arm.pick("cube")
        arm.halt()                              # a StopVerdict; never raises

Each name is imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.fleet.fleet import Fleet, connect
    from strands_robots.fleet.remote_robot import RemoteRobot

__all__ = ["Fleet", "RemoteRobot", "connect"]

_HOMES = {"Fleet": "fleet", "RemoteRobot": "remote_robot", "connect": "fleet"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
