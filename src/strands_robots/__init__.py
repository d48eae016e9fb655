"""Robots on a network where agents find, drive and always can stop them.

Every name is loaded when it is first used, so that the package imports with no extra installed.
"""

from __future__ import annotations

import sys
from importlib import import_module

__version__ = "0.1.0"

TYPE_CHECKING = False  # importing typing would be most of this import's time
if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from typing import Any

    from strands_robots.fleet import connect
    from strands_robots.hardware import HardwareRobot
    from strands_robots.robot import Robot, run
    from strands_robots.safety.gate import Permit
    from strands_robots.simulation import Simulation
    from strands_robots.verb_declaration import verb
    from strands_robots.verb_parameters import Domain

__all__ = ["Domain", "HardwareRobot", "Permit", "Robot", "Simulation", "__version__", "connect", "run", "verb"]

_HOMES = {
    "Domain": "strands_robots.verb_parameters",
    "HardwareRobot": "strands_robots.hardware",
    "Permit": "strands_robots.safety.gate",
    "Robot": "strands_robots.robot",
    "Simulation": "strands_robots.simulation",
    "connect": "strands_robots.fleet.fleet",
    "run": "strands_robots.robot",
    "verb": "strands_robots.verb_declaration",
}
_SIM_PACKAGES = ("mujoco", "numpy", "PIL")


def __getattr__(name: str) -> Any:
    try:
        if name in _HOMES:
            return getattr(import_module(_HOMES[name]), name)
        return import_module("strands_robots.moved").moved_name(__name__, name)
    except ModuleNotFoundError as exc:
        if (exc.name or "").partition(".")[0] not in _SIM_PACKAGES:
            raise
        utils = import_module("strands_robots.utils")
        raise utils.missing_extra(name, "sim") from exc


def __dir__() -> list[str]:
    return sorted(__all__)


class _MovedModules:
    """Finder of modules that strands-robots 0.5 had; asked for what no other finds."""

    @staticmethod
    def find_spec(path: str, where: object = None, target: object = None) -> ModuleSpec | None:
        if not path.startswith(f"{__name__}.") or path == f"{__name__}.moved":
            return None
        found: ModuleSpec | None = import_module(f"{__name__}.moved").spec_of(path)
        return found


sys.meta_path.append(_MovedModules)
