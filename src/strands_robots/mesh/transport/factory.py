"""The transport that ``STRANDS_MESH_BACKEND`` names."""

from __future__ import annotations

from typing import TYPE_CHECKING

from strands_robots import settings
from strands_robots.mesh import transport
from strands_robots.moved import of_module

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


CLASSES = {
    "zenoh": "ZenohTransport",
    "iot": "IotMqttTransport",
    "bridge": "BridgeTransport",
    "memory": "MemoryTransport",
}
"""The class of each backend; it is loaded when it is used."""


def make_transport(backend: str | None = None) -> transport.Transport:
    """Return a transport, not yet connected.

    Raises:
        TransportError: an unknown backend.
        MissingExtraError: its extra is not installed.
    """
    name = (backend or settings.raw("STRANDS_MESH_BACKEND")).lower()
    if name not in CLASSES:
        raise transport.TransportError(f"STRANDS_MESH_BACKEND must be one of {', '.join(CLASSES)}, not {name!r}.")
    made: transport.Transport = getattr(transport, CLASSES[name])()
    return made
