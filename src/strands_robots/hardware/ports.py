"""The serial port of an arm: one sentence where there is none, or another one than was asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from strands_robots.utils import ValidationError, shown

_PATTERNS = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "tty.usbmodem*", "tty.usbserial*")
"""Where USB serial adapters appear on Linux, by their own names first, and on macOS."""

_TOLD = 8


def serial_ports(dev: Path = Path("/dev")) -> list[str]:
    """USB serial ports of this machine; those that have names of their own are given by these alone."""
    for pattern in _PATTERNS:
        found = sorted(str(path) for path in dev.glob(pattern))
        if found:
            return found
    return []


def check_port(name: str, port: object, *, needed: bool) -> None:
    """Refuse a port that is none.

    Raises:
        ValidationError: no text, or nothing where the robot needs a port.
    """
    if port is None and not needed:
        return
    if not isinstance(port, str) or not port.strip():
        given = "" if port is None else f", not {shown(port)}"
        raise ValidationError(f"{name} needs port, its serial port, such as /dev/ttyACM0{given}; {_here()}.")


def require_port(device: Any) -> None:
    """Refuse a device whose port is not on this machine.

    Raises:
        ConnectionError: its ``config.port`` is a path with nothing there.
    """
    port = getattr(getattr(device, "config", None), "port", None)
    if isinstance(port, str) and port.startswith("/") and not Path(port).exists():
        raise ConnectionError(f"the port {port} is not there; {_here()}")


def _here() -> str:
    found = serial_ports()
    return f"connected here: {', '.join(found[:_TOLD])}" if found else "no USB serial port is connected here"
