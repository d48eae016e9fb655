"""Device Connect: robots and simulations as devices that agents drive and stop.

::

    from strands_robots.device_connect import init_device_connect_sync, stop_device_connect

    runtime = init_device_connect_sync(robot, peer_id="so100-lab-1")
    ...
    stop_device_connect(runtime)

Each name is imported on first use: importing this package needs no extra and costs next to nothing. A name that needs
the framework names the [device-connect] extra when that is missing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from device_connect_edge import DeviceRuntime

    from strands_robots.device_connect.backends import LinkConfig, link_from_environment, loopback_config
    from strands_robots.device_connect.bringup import (
        init_device_connect,
        init_device_connect_sync,
        stop_device_connect,
    )
    from strands_robots.device_connect.client import FleetClient, connect_agent
    from strands_robots.device_connect.reachy_mini_driver import ReachyMiniDriver
    from strands_robots.device_connect.robot_driver import RobotDeviceDriver
    from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
    from strands_robots.safety.sightings import DuplicateDeviceError
    from strands_robots.threads import LOOP_JOIN_TIMEOUT_S as _LOOP_JOIN_TIMEOUT_S
    from strands_robots.threads import StopSignal

__all__ = [
    "_LOOP_JOIN_TIMEOUT_S",
    "DeviceRuntime",
    "DuplicateDeviceError",
    "FleetClient",
    "LinkConfig",
    "ReachyMiniDriver",
    "RobotDeviceDriver",
    "SimulationDeviceDriver",
    "StopSignal",
    "connect_agent",
    "init_device_connect",
    "init_device_connect_sync",
    "link_from_environment",
    "loopback_config",
    "stop_device_connect",
]

_HERE = "strands_robots.device_connect"
_HOMES = {
    "_LOOP_JOIN_TIMEOUT_S": "strands_robots.threads",
    "DeviceRuntime": "device_connect_edge",
    "DuplicateDeviceError": "strands_robots.safety.sightings",
    "FleetClient": f"{_HERE}.client",
    "LinkConfig": f"{_HERE}.backends",
    "ReachyMiniDriver": f"{_HERE}.reachy_mini_driver",
    "RobotDeviceDriver": f"{_HERE}.robot_driver",
    "SimulationDeviceDriver": f"{_HERE}.simulation_driver",
    "StopSignal": "strands_robots.threads",
    "connect_agent": f"{_HERE}.client",
    "init_device_connect": f"{_HERE}.bringup",
    "init_device_connect_sync": f"{_HERE}.bringup",
    "link_from_environment": f"{_HERE}.backends",
    "loopback_config": f"{_HERE}.backends",
    "stop_device_connect": f"{_HERE}.bringup",
}
_FRAMEWORK = ("device_connect_edge", "device_connect_agent_tools", "zenoh", "nats", "pydantic")


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        return import_module("strands_robots.moved").moved_name(__name__, name)
    try:
        value = getattr(import_module(home), name.lstrip("_"))
    except ModuleNotFoundError as exc:
        if exc.name is None or exc.name.partition(".")[0] not in _FRAMEWORK:
            raise
        utils = import_module("strands_robots.utils")
        raise utils.missing_extra("Device Connect", "device-connect") from exc
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})


def load_when_used() -> None:
    """Have the framework's package run at the first use of a name in it.

    Its submodules import without that.
    ``device_connect_edge/__init__.py`` imports its runtime, pydantic's models and OpenTelemetry, ten times the time of
    the messaging package, which is all that a client needs.

    For processes of our own alone: an application may rely on what the import does. Nothing happens where the package
    is imported already or is not installed.
    """
    import threading  # noqa: PLC0415 - importing this package costs next to nothing
    from importlib.util import find_spec, module_from_spec  # noqa: PLC0415 - as above

    spec = None if _FRAMEWORK[0] in sys.modules else find_spec(_FRAMEWORK[0])
    if spec is None or spec.loader is None:
        return
    module, loader = module_from_spec(spec), spec.loader
    running = threading.RLock()

    def run_then_get(name: str) -> Any:
        with running:
            if vars(module).pop("__getattr__", None) is not None:
                loader.exec_module(module)
        return getattr(module, name)

    vars(module)["__getattr__"] = run_then_get
    sys.modules[_FRAMEWORK[0]] = module
