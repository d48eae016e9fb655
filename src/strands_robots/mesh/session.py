"""The mesh's shared session and the registry of peers: one of each in a process.

The session is opened with its first user and closed with its last. Without stated endpoints (``ZENOH_CONNECT``,
``ZENOH_LISTEN``) the first process of a machine is the hub on ``tcp/127.0.0.1:STRANDS_MESH_PORT`` and the others
are its clients; when it dies a survivor takes the port. Zenoh is imported with the first session, not before.
"""

from __future__ import annotations

import atexit
import logging
import threading
from typing import Any

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.mesh.registry import PEER_TIMEOUT, PeerRegistry
from strands_robots.mesh.transport import Transport, TransportError
from strands_robots.mesh.transport.factory import make_transport
from strands_robots.mesh.wire import WireError
from strands_robots.utils import MissingExtraError, number

__all__ = [
    "PEER_TIMEOUT",
    "acquire",
    "clear_peers",
    "current_session",
    "get_peer",
    "get_peers",
    "get_session",
    "prune_peers",
    "put",
    "registry",
    "release_session",
    "session_alive",
    "update_peer",
    "zenoh_error_types",
]

logger = logging.getLogger(__name__)

_registry = PeerRegistry(
    most=lambda: settings.integer("STRANDS_MESH_MAX_PEERS"),
    retention=lambda: settings.number("STRANDS_MESH_PEER_RETENTION_S"),
)


class _Shared:
    """The one transport of this process and how many hold it."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.transport: Transport | None = None
        self.holders = 0

    def acquire(self) -> Transport | None:
        if mesh_env_request() is False:
            return None
        with self.lock:
            if self.transport is None:
                try:
                    transport = make_transport()
                    transport.connect()
                except (TransportError, MissingExtraError) as exc:
                    logger.error("The mesh has no session: %s", exc)  # noqa: TRY400 - one sentence, no trace
                    return None
                self.transport = transport
            self.holders += 1
            return self.transport

    def release(self) -> None:
        with self.lock:
            if self.transport is None:
                return
            self.holders -= 1
            if self.holders > 0:
                return
            transport, self.transport, self.holders = self.transport, None, 0
        try:
            transport.close()
        except zenoh_error_types() as exc:
            logger.warning("The mesh's session did not close in good order: %s", exc)
        else:
            logger.info("The mesh's session is closed.")

    def end(self) -> None:
        """Close whoever still holds it: Zenoh hangs an interpreter that ends with a subscriber declared."""
        with self.lock:
            self.holders = min(self.holders, 1)
        self.release()


_shared = _Shared()
atexit.register(_shared.end)


def acquire() -> Transport | None:
    """One reference to the shared transport; None when the mesh is off or cannot be opened, which is logged."""
    return _shared.acquire()


def get_session() -> Any | None:
    """One reference to the shared session: a ``zenoh.Session``, or the transport of another backend, or None."""
    return _shown(acquire())


def release_session() -> None:
    """Give one reference back; the last one closes the session."""
    _shared.release()


def current_session() -> Any | None:
    """The session as it is, without taking a reference."""
    return _shown(_shared.transport)


def session_alive() -> bool:
    """Whether the session is open."""
    transport = _shared.transport
    return transport is not None and transport.is_alive()


def put(key: str, data: dict[str, Any]) -> None:
    """Publish a JSON object and return at once; nothing happens while no session is open.

    A message that cannot be sent is logged at WARNING.
    """
    transport = _shared.transport
    if transport is None:
        return
    try:
        transport.put(key, data)
    except (TransportError, WireError) as exc:
        logger.warning("%s was not published: %s", key, exc)


def zenoh_error_types() -> tuple[type[BaseException], ...]:
    """What Zenoh raises for faults of the transport, besides the operating system's; no ZError without Zenoh."""
    try:
        import zenoh  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        return (OSError, RuntimeError)
    return (zenoh.ZError, OSError, RuntimeError)


def registry() -> PeerRegistry:
    """The registry that every mesh of this process shares."""
    return _registry


def get_peers() -> list[dict[str, Any]]:
    """All known peers, as plain dicts."""
    return _registry.all()


def get_peer(peer_id: str, max_age_s: float | None = None) -> dict[str, Any] | None:
    """One peer, or None when it is unknown or silent for longer than ``max_age_s`` seconds.

    Raises:
        ValidationError: ``max_age_s`` is not positive and finite.
    """
    return _registry.get(peer_id, None if max_age_s is None else number("max_age_s", max_age_s, above=0))


def update_peer(peer_id: str, peer_type: str, hostname: str, caps: dict[str, Any]) -> bool:
    """Insert or refresh a peer. True when it is new."""
    return _registry.update(peer_id, peer_type, hostname, caps)


def clear_peers() -> None:
    """Forget every peer. For tests."""
    _registry.clear()


def prune_peers(timeout: float = PEER_TIMEOUT) -> list[str]:
    """Forget the peers silent for longer than ``timeout`` and ``STRANDS_MESH_PEER_RETENTION_S``; their ids."""
    return _registry.prune(number("timeout", timeout, above=0))


def _shown(transport: Transport | None) -> Any | None:
    # A Zenoh user is given the raw session, which its documentation speaks of.
    return getattr(transport, "session", None) or transport
