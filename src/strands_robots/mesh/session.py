"""The one mesh session of a process, and its one registry of peers.

The session is opened for its first user and closed with its last. Without stated endpoints (``STRANDS_MESH_CONNECT``,
``STRANDS_MESH_LISTEN``, else ``ZENOH_CONNECT``, ``ZENOH_LISTEN``) the first process of a machine is the hub on
``tcp/127.0.0.1:STRANDS_MESH_PORT`` and the others are its clients; when it dies a survivor takes the port. Zenoh is
imported with the first session, not before.
"""

from __future__ import annotations

import atexit
import logging
import os
import threading
from collections.abc import Mapping
from typing import Any

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.mesh.older_peers import Pacer
from strands_robots.mesh.registry import PEER_TIMEOUT, PeerRegistry
from strands_robots.mesh.transport import Transport, TransportError
from strands_robots.mesh.transport.factory import make_transport
from strands_robots.mesh.transport.zenoh_config import stated_endpoints
from strands_robots.mesh.wire import WireError
from strands_robots.safety.network_key import MESH, NetworkKey
from strands_robots.utils import MissingExtraError, number

__all__ = [
    "PEER_TIMEOUT",
    "acquire",
    "clear_peers",
    "current_session",
    "cut_off",
    "dial",
    "get_peer",
    "get_peers",
    "get_session",
    "network",
    "opened_with",
    "pacer",
    "prune_peers",
    "put",
    "registry",
    "release_session",
    "session_alive",
    "stated_mesh",
    "update_peer",
    "zenoh_error_types",
]

logger = logging.getLogger(__name__)

_NAMES_THE_MESH = (
    "STRANDS_MESH_BACKEND",
    "STRANDS_MESH_PORT",
    "STRANDS_MESH_CONNECT",
    "STRANDS_MESH_LISTEN",
    "ZENOH_CONNECT",
    "ZENOH_LISTEN",
    "STRANDS_MESH_MULTICAST",
    "STRANDS_MESH_NAMESPACE",
    "STRANDS_MESH_AUTH_MODE",
    "STRANDS_MESH_I_KNOW_THIS_IS_INSECURE",
    "STRANDS_MESH_LOCAL_DEV",
    "STRANDS_MESH_TLS_CA",
    "STRANDS_MESH_TLS_CERT",
    "STRANDS_MESH_TLS_KEY",
    "STRANDS_MESH_ACL_FILE",
    "STRANDS_IOT_ENDPOINT",
)

_registry = PeerRegistry(
    most=lambda: settings.integer("STRANDS_MESH_MAX_PEERS"),
    retention=lambda: settings.number("STRANDS_MESH_PEER_RETENTION_S"),
)
_pacer = Pacer()


class _Shared:
    """The one transport of this process, and the number of references to it."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.transport: Transport | None = None
        self.opened_with: Mapping[str, str] = {}
        self.references = 0

    def acquire(self) -> Transport | None:
        """Take a reference to the shared transport; None, logged, where there is none."""
        if mesh_env_request() is False:
            return None
        with self.lock:
            if self.transport is None:
                stated = stated_mesh()
                try:
                    transport = make_transport()
                    transport.connect()
                except (TransportError, MissingExtraError) as exc:
                    logger.error("The mesh has no session: %s", exc)  # noqa: TRY400 - one sentence, no trace
                    return None
                self.transport, self.opened_with = transport, stated
            # A robot of this process may become the hub, though the first user of the session only dialled.
            self.transport.take_part()
            self.references += 1
            return self.transport

    def dial(self) -> Transport:
        """Take a reference as a caller without a robot, which never becomes the hub.

        Raises:
            TransportError: the mesh is switched off, or there is no hub, stated endpoint or multicast to reach it by.
            MissingExtraError: the transport's extra is not installed.
        """
        if mesh_env_request() is False:
            raise TransportError("STRANDS_MESH switches the mesh off.")
        with self.lock:
            if self.transport is None:
                stated = stated_mesh()
                transport = make_transport()
                transport.dials_only = True
                transport.connect()
                self.transport, self.opened_with = transport, stated
            self.references += 1
            return self.transport

    def release(self) -> None:
        """Release one reference; the last one closes the session."""
        with self.lock:
            if self.transport is None:
                return
            self.references -= 1
            if self.references > 0:
                return
            transport, self.transport, self.references = self.transport, None, 0
        try:
            transport.close()
        except zenoh_error_types() as exc:
            logger.warning("The mesh's session did not close in good order: %s", exc)
        else:
            logger.info("The mesh's session is closed.")

    def close(self) -> None:
        """Close it whatever the references: Zenoh would hang the interpreter's end."""
        with self.lock:
            self.references = min(self.references, 1)
        self.release()


_shared = _Shared()
atexit.register(_shared.close)


acquire = _shared.acquire
dial = _shared.dial
release_session = _shared.release


def get_session() -> Any | None:
    """Take a reference to the shared session, a ``zenoh.Session`` by default."""
    return _session_of(acquire())


def current_session() -> Any | None:
    """Return the session, if it is open, without taking a reference."""
    return _session_of(_shared.transport)


def session_alive() -> bool:
    """True while the session is open."""
    transport = _shared.transport
    return transport is not None and transport.is_alive()


def cut_off() -> bool:
    """True while the session is open, and linked to no hub or broker."""
    transport = _shared.transport
    return transport is not None and transport.cut_off()


def opened_with() -> Mapping[str, str] | None:
    """Return :func:`stated_mesh` of the open session; None without a session."""
    with _shared.lock:
        return None if _shared.transport is None else _shared.opened_with


def stated_mesh(instead: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the settings that say which mesh is joined, equal for the same mesh.

    Args:
        instead: settings by variable that count instead of the environment's; an empty one is the default.
    """
    values = {name: settings.raw(name) for name in _NAMES_THE_MESH}
    values |= {name: value or settings.default(name) for name, value in (instead or {}).items()}
    for way in ("CONNECT", "LISTEN"):
        stated, shared = values.pop(f"STRANDS_MESH_{way}"), values.pop(f"ZENOH_{way}")
        values[way] = "" if stated == settings.NO_ENDPOINT else stated or shared
    if values["CONNECT"] or values["LISTEN"]:
        # The port is where peers without an endpoint meet.
        del values["STRANDS_MESH_PORT"]
    return values


def put(key: str, data: dict[str, Any]) -> None:
    """Publish a JSON object at once; nothing happens while no session is open.

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
    """Exception types of a transport's faults; ``ZError`` only with Zenoh."""
    try:
        import zenoh  # noqa: PLC0415 - optional, loaded when used
    except ImportError:
        return (OSError, RuntimeError)
    return (zenoh.ZError, OSError, RuntimeError)


def network() -> NetworkKey:
    """Return the key of the mesh that this process joins, from its settings."""
    backend = settings.raw("STRANDS_MESH_BACKEND").lower()
    endpoints = [each for stated in stated_endpoints() for each in stated]
    if backend in ("zenoh", "bridge") and not endpoints:
        endpoints = [f"tcp/127.0.0.1:{settings.integer('STRANDS_MESH_PORT')}"]
    broker = settings.raw("STRANDS_IOT_ENDPOINT")
    if backend == "bridge" and broker:
        endpoints.append(broker)
    elif backend == "iot":
        endpoints = [broker]
    elif backend == "memory":
        endpoints = [f"memory-{os.getpid()}"]
    return NetworkKey.of(MESH, endpoints)


def registry() -> PeerRegistry:
    """Return the registry that every mesh of this process shares."""
    return _registry


def pacer() -> Pacer:
    """Return the pacer that every mesh of this process shares, as it shares the link."""
    return _pacer


def get_peers() -> list[dict[str, Any]]:
    """Return all known peers as plain dicts."""
    return _registry.all()


def get_peer(peer_id: str, max_age_s: float | None = None) -> dict[str, Any] | None:
    """Return one peer, or None when it is unknown or silent for over ``max_age_s`` s.

    Raises:
        ValidationError: ``max_age_s`` is not positive and finite.
    """
    return _registry.get(peer_id, None if max_age_s is None else number("max_age_s", max_age_s, above=0))


def update_peer(peer_id: str, peer_type: str, hostname: str, caps: dict[str, Any]) -> bool:
    """Insert or refresh a peer; True when it is new."""
    return _registry.update(peer_id, peer_type, hostname, caps)


def clear_peers() -> None:
    """Remove every peer; for tests."""
    _registry.clear()


def prune_peers(timeout: float = PEER_TIMEOUT) -> list[str]:
    """Remove the peers silent for longer than ``timeout`` s and return their ids."""
    return _registry.prune(number("timeout", timeout, above=0))


def _session_of(transport: Transport | None) -> Any | None:
    # Users of Zenoh expect its own session object.
    return getattr(transport, "session", None) or transport
