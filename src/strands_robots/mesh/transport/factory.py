"""The transport that ``STRANDS_MESH_BACKEND`` names."""

from __future__ import annotations

from strands_robots import settings
from strands_robots.mesh.transport import Transport, TransportError

BACKENDS = ("zenoh", "iot", "bridge", "memory")


def make_transport(backend: str | None = None) -> Transport:
    """Return a transport, not yet connected.

    Raises:
        TransportError: an unknown backend.
        MissingExtraError: its extra is not installed.
    """
    name = (backend or settings.raw("STRANDS_MESH_BACKEND")).lower()
    if name == "zenoh":
        from strands_robots.mesh.transport.zenoh import ZenohTransport  # noqa: PLC0415 - each backend loads alone

        return ZenohTransport()
    if name == "memory":
        from strands_robots.mesh.transport.memory import SHARED, MemoryTransport  # noqa: PLC0415 - likewise

        return MemoryTransport(SHARED)
    if name == "iot":
        from strands_robots.mesh.transport.iot import IotMqttTransport  # noqa: PLC0415 - likewise

        return IotMqttTransport()
    if name == "bridge":
        from strands_robots.mesh.transport.bridge import BridgeTransport  # noqa: PLC0415 - likewise

        return BridgeTransport()
    raise TransportError(f"STRANDS_MESH_BACKEND must be one of {', '.join(BACKENDS)}, not {name!r}.")
