"""The documented second door to :mod:`strands_robots.drivers.reachy_transport`."""

from __future__ import annotations

from typing import Any

from strands_robots.drivers import reachy_transport
from strands_robots.drivers.reachy_transport import api

__all__ = ["WebSocketLink", "ZenohLink", "api"]  # noqa: F822 - the links are given by __getattr__


def __getattr__(name: str) -> Any:
    if name in ("WebSocketLink", "ZenohLink"):
        return getattr(reachy_transport, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
