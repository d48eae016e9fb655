"""The mesh of a caller: that of a profile, or this machine's.

This machine's is looked for before any code of the mesh is loaded.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from strands_robots import settings
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import MESH, NetworkBusyError
from strands_robots.safety import network_key
from strands_robots.safety.network_key import NetworkKey

if TYPE_CHECKING:
    from strands_robots.fleet.adapter import NetworkAdapter
    from strands_robots.safety.network_key import NetworkKey

CONNECT_S = 0.2
"""Seconds in which the hub takes a connection."""


class MeshSettings:
    """Settings of one fleet's mesh, by variable; empty for those of the environment."""

    _lock: ClassVar[threading.Lock] = threading.Lock()
    _joined: ClassVar[list[Mapping[str, str]]] = []
    _before: ClassVar[dict[str, str]] = {}

    def __init__(self, stated: Mapping[str, str]) -> None:
        self._stated = dict(stated)

    def take(self) -> None:
        """Put the settings, until as many fleets of them have given them back.

        Raises:
            UnreachableError: the process is on another mesh.
        """
        from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used

        with self._lock:
            if self._joined and self._joined[0] != self._stated:
                raise UnreachableError("this process is on the mesh of another connection profile")
            live = session.opened_with()
            # A session outlives its profile's fleet while a robot of this process uses it.
            if live is not None and live != session.stated_mesh(self._stated):
                whose = "the profile's" if self._stated else "the environment's"
                raise UnreachableError(f"this process is on a mesh already, with other settings than {whose}")
            if not self._joined:
                self._before.update({name: settings.verbatim(name) for name in self._stated})
                put_settings(self._stated)
                self._forget_peers()
            self._joined.append(self._stated)

    def give_back(self) -> None:
        """Restore what was before, with the last fleet of these settings."""
        with self._lock:
            self._joined.pop()
            if self._joined:
                return
            put_settings(self._before)
            self._before.clear()
            self._forget_peers()

    def _forget_peers(self) -> None:
        """Forget the peers of the mesh that this process was on."""
        from strands_robots.mesh import session  # noqa: PLC0415 - as above

        # Robots that restart meanwhile have other sessions, and would be taken for strangers.
        if not session.session_alive():
            session.clear_peers()


def put_settings(stated: Mapping[str, str]) -> None:
    """Put settings by variable, for this process and its children."""
    for name, value in stated.items():
        settings.put(name, value)


def local_key() -> NetworkKey:
    """Return the name of this machine's mesh, as ``mesh.session`` has it."""
    return NetworkKey.of(network_key.MESH, [f"tcp/127.0.0.1:{settings.integer('STRANDS_MESH_PORT')}"])


def no_hub() -> str:
    """Return why this machine has no mesh, or "" where it may have one."""
    port = settings.integer("STRANDS_MESH_PORT")
    # Not by create_connection, which loads the tables of international names.
    with socket.socket() as probe:
        probe.settimeout(CONNECT_S)
        return f"no mesh answers on 127.0.0.1:{port}" if probe.connect_ex(("127.0.0.1", port)) else ""


ANSWER_S = 1.0
"""Seconds in which it answers."""

BROADCAST = "strands/broadcast"
"""Topic that every peer of the mesh subscribes to, those of earlier releases too."""


class LocalMesh:
    """Mesh of this machine as a network, joined where it has a peer.

    Its methods are those of :class:`~strands_robots.fleet.mesh.network.MeshNetwork`, once it was joined.

    Args:
        make: makes that network, once a mesh is there.
    """

    name = MESH
    has_stop_link = False
    tells_absence = False

    def __init__(self, make: Callable[[], NetworkAdapter]) -> None:
        self._make = make
        self._found: NetworkAdapter | None = None

    def open(self) -> None:
        """Join; raise :class:`UnreachableError` where the mesh has no peer."""
        if self._found is None:
            if why := no_hub():
                raise UnreachableError(why)
            # A port with certificates is none of Device Connect's.
            if why := "" if settings.raw("STRANDS_MESH_TLS_CA") else no_peers():
                raise NetworkBusyError(why) if why == _hangs() else UnreachableError(why)
            self._found = self._make()
        self._found.open()

    def close(self) -> None:
        """Leave the mesh."""
        if self._found is not None:
            self._found.close()

    @property
    def key(self) -> NetworkKey:
        """The name of this mesh."""
        return local_key()

    def __getattr__(self, name: str) -> Any:
        if name == "_found" or self._found is None:
            raise UnreachableError("the mesh is not joined")
        return getattr(self._found, name)


def no_peers() -> str:
    """Return why no peer of the mesh is reached by its port on this machine, or "".

    Robots of Device Connect meet at the same port by default, so one that listens there need not be on a mesh.
    """
    import zenoh  # noqa: PLC0415 - an optional dependency, loaded when it is used

    port = settings.integer("STRANDS_MESH_PORT")
    config = {
        "mode": "client",
        "namespace": settings.raw("STRANDS_MESH_NAMESPACE"),
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": int(ANSWER_S * 1000)},
        "scouting": {"multicast": {"enabled": False}},
    }
    absent = f"no peer of a mesh is behind 127.0.0.1:{port}"
    try:
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            publisher = session.declare_publisher(BROADCAST)
            asked = time.monotonic()
            # The hub answers in order: before it answers this question it has named the subscribers.
            list(session.liveliness().get(BROADCAST, timeout=ANSWER_S))
            # The stub has it as a bool.
            if publisher.matching_status.matching:  # type: ignore[attr-defined]
                return ""
            return absent if time.monotonic() - asked < ANSWER_S else _hangs()
    except zenoh.ZError:
        return _hangs()


def _hangs() -> str:
    return f"127.0.0.1:{settings.integer('STRANDS_MESH_PORT')} takes connections, and no mesh answers there in time"
