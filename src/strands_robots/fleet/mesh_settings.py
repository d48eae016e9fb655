"""Settings of the mesh that a connection profile states.

A process has one session on the mesh, made from its settings. So a profile's are put for the whole process while a
fleet of that profile is joined, and a fleet of another one is refused meanwhile: it would reach the wrong robots.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Mapping
from typing import ClassVar

from strands_robots import settings
from strands_robots.errors import UnreachableError
from strands_robots.safety import network_key
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

        if self._stated and not session.session_alive():
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
