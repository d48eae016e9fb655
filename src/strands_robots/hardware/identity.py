"""What of a device stays when its process ends, so that a lockout finds the same hardware again."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

BY_ID = Path("/dev/serial/by-id")
"""Where Linux names serial ports by the make and serial number of their adapter."""

_HOSTS = ("remote_ip", "robot_ip", "ip_address", "host", "ip")


def stable_id(device: Any, by_id: Path = BY_ID) -> str | None:
    """The serial adapter's own id, else the host it is reached at, else its calibration id; None where it has none.

    A calibration id goes with its port: two arms of one type may share it. A port without an id of its own keeps its
    name for as long as nobody plugs it elsewhere.
    """
    config = getattr(device, "config", None)
    port = _word(config, "port")
    if port:
        named = _adapter(port, by_id)
        if named:
            return named
    host = next((word for word in (_word(config, name) for name in _HOSTS) if word), "")
    if host:
        return host
    parts = [_word(device, "id") or _word(config, "id"), port]
    return "@".join(part for part in parts if part) or None


def kind(device: Any) -> str:
    """The device's type: LeRobot's name of it, else that of its class."""
    return _word(device, "name") or type(device).__name__


def _adapter(port: str, by_id: Path) -> str:
    if Path(port).parent == by_id:
        return Path(port).name
    target = os.path.realpath(port)
    # Without such a folder, or with one that is not to be read, no adapter has a name.
    with contextlib.suppress(OSError):
        for link in sorted(by_id.iterdir()):
            if os.path.realpath(link) == target:
                return link.name
    return ""


def _word(owner: Any, name: str) -> str:
    value = getattr(owner, name, None)
    return value.strip() if isinstance(value, str) else ""
