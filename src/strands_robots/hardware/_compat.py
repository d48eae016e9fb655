"""Use of LeRobot 0.4.4 and 0.6.1 beyond its documented interface.

LeRobot's motor drivers need no torch, but importing them loads helpers that do: ``lerobot.utils.utils`` imports torch,
accelerate and datasets at its top, and ``lerobot.processor``, of which the drivers use two type aliases, all of torch
besides. Where torch is not installed, empty modules stand in their place for as long as a driver is being imported,
and no longer. Where it is installed nothing stands in for anything.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from strands_robots.policies.lerobot_local import LEROBOT_IMPORTS

_STANDINS: Mapping[str, tuple[str, ...]] = {
    "torch": ("device", "dtype", "Tensor"),
    "accelerate": ("Accelerator",),
    "datasets": (),
    "datasets.utils": (),
    "datasets.utils.logging": ("disable_progress_bar", "enable_progress_bar"),
    "lerobot.processor": ("RobotAction", "RobotObservation"),
}
"""Names that LeRobot's drivers import, by module. None of them is called by a driver."""


def light() -> bool:
    """Return True where torch is not installed, so that LeRobot has to do without it."""
    return importlib.util.find_spec("torch") is None


def lerobot_module(name: str) -> ModuleType:
    """Import a module of LeRobot's; its drivers also where torch is missing.

    Raises:
        ModuleNotFoundError: LeRobot, or something the module really needs, is not installed.
    """
    with lerobot_imports():
        return importlib.import_module(name)


@contextmanager
def lerobot_imports() -> Iterator[None]:
    """Let what runs inside import LeRobot's drivers, also where torch is missing."""
    with LEROBOT_IMPORTS:
        if not light():
            yield
            return
        with _standing_in():
            yield


@contextmanager
def _standing_in() -> Iterator[None]:
    put = {name: _standin(name, classes) for name, classes in _STANDINS.items() if name not in sys.modules}
    sys.modules.update(put)
    try:
        yield
    finally:
        for name, module in put.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]


def _standin(name: str, classes: tuple[str, ...]) -> ModuleType:
    module = ModuleType(name, "Stands in while a LeRobot driver is imported without torch.")
    module.__spec__ = ModuleSpec(name, None)
    module.__path__ = []
    for each in classes:
        setattr(module, each, type(each, (), {}))
    return module


def unplugged(device: Any) -> bool:
    """Return True when the open serial port of a LeRobot device is gone.

    LeRobot calls a bus connected for as long as its port object is open, also when the cable is out. The node of a
    removed port has no name left, so the open file has no links.
    """
    serial = getattr(getattr(getattr(device, "bus", None), "port_handler", None), "ser", None)
    if serial is None or not getattr(serial, "is_open", False):
        return False
    try:
        return os.fstat(serial.fileno()).st_nlink == 0
    except OSError:
        return True


def reopened(device: Any) -> bool:
    """Open the serial port of a LeRobot device that was gone, and write nothing.

    Returns:
        False where the port is still gone, or the device has none.
    """
    bus: Any = getattr(device, "bus", None)
    handler = getattr(bus, "port_handler", None)
    if handler is None:
        return False
    if handler.is_open and not unplugged(device):
        return True
    handler.is_using = False
    if handler.is_open:
        handler.closePort()
    try:
        bus.connect(handshake=False)
    except (OSError, TypeError):  # pySerial's of a closed port is a TypeError
        return False
    return True


def forget_input(device: Any) -> None:
    """Discard unread bytes of the serial port of a LeRobot device."""
    serial = getattr(getattr(getattr(device, "bus", None), "port_handler", None), "ser", None)
    # A driver on another bus may keep anything under that name.
    reset = getattr(serial, "reset_input_buffer", None)
    if callable(reset) and getattr(serial, "is_open", False) and not unplugged(device):
        reset()


def stop_base(device: Any, still: Mapping[str, float]) -> None:
    """Stop the wheels of a device that has joints as well, without a read.

    LeRobot's LeKiwi reads its arm before it writes a bounded step (``max_relative_target``), and cannot write to the
    wheels alone with ``send_action``.

    Args:
        device: the device; one without LeRobot's ``stop_base()`` is sent ``still``.
        still: zero for every velocity.
    """
    own = getattr(device, "stop_base", None)
    if callable(own):
        own()
    else:
        device.send_action(dict(still))


def drop(device: Any) -> None:
    """Close the port of a LeRobot device that is gone or silent, for another try.

    LeRobot leaves the port open when its handshake fails, and an exchange that broke off leaves the SDK's port marked
    as in use, so that every later one would be refused. Nothing for a device without such a port.
    """
    handler = getattr(getattr(device, "bus", None), "port_handler", None)
    if handler is None:
        return
    handler.is_using = False
    if handler.is_open:
        handler.closePort()
    for camera in getattr(device, "cameras", {}).values():
        if camera.is_connected:
            camera.disconnect()
