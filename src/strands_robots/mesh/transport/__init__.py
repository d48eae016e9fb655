"""Transports of the mesh: in memory, Zenoh, MQTT 5 (AWS IoT), and both at once. Loaded when they are named."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from strands_robots.mesh.transport.base import Sample, Subscription, Transport, TransportError

if TYPE_CHECKING:
    from strands_robots.mesh.transport.bridge import BridgeTransport
    from strands_robots.mesh.transport.iot import IotMqttTransport
    from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
    from strands_robots.mesh.transport.zenoh import ZenohTransport

__all__ = [
    "BridgeTransport",
    "IotMqttTransport",
    "MemoryBus",
    "MemoryTransport",
    "Sample",
    "Subscription",
    "Transport",
    "TransportError",
    "ZenohTransport",
]

_HOMES = {
    "BridgeTransport": "bridge",
    "IotMqttTransport": "iot",
    "MemoryBus": "memory",
    "MemoryTransport": "memory",
    "ZenohTransport": "zenoh",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
