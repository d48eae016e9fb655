"""Clocks and peers on the in-memory transport, for the tests of this folder."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from strands_robots.mesh.assembly import Parts
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.registry import PeerRegistry
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
from strands_robots.mesh.wire_identity import Identity
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane


class Clock:
    """Seconds that pass only when told to, from the real time on."""

    def __init__(self) -> None:
        self.at = time.time()

    def __call__(self) -> float:
        return self.at

    def pass_(self, seconds: float) -> None:
        self.at += seconds


class RealClock(Clock):
    """Seconds as they pass."""

    def __call__(self) -> float:
        return time.time()


class Fleet:
    """Peers in one process, each as if alone in a process of its own: own session, registry and safety plane."""

    def __init__(self, folder: Path, clock: Clock | None = None) -> None:
        self.bus = MemoryBus()
        self.clock = clock or Clock()
        self.meshes: list[Mesh] = []
        self.transports: dict[str, MemoryTransport] = {}
        self.audit: list[tuple[str, str, dict[str, Any]]] = []
        self.planes: dict[str, SafetyPlane] = {}
        self._folder = folder

    def parts(self, peer_id: str, *, identity: Identity | None = None, sessionless: bool = False) -> Parts:
        transport = MemoryTransport(self.bus, sessionless=sessionless)
        self.transports[peer_id] = transport
        own = self.planes[peer_id] = SafetyPlane(LockoutStore(self._folder / peer_id), deadline_s=20.0)

        def acquire() -> MemoryTransport:
            transport.connect()
            return transport

        return Parts(
            acquire=acquire,
            release=transport.close,
            registry=PeerRegistry(clock=self.clock),
            clock=self.clock,
            monotonic=self.clock,
            identity=lambda _: identity or Identity(),
            audit=lambda event, peer, payload: self.audit.append((event, peer, payload)),
            plane=own,
        )

    def join(self, robot: Any, peer_id: str, peer_type: str = "robot", **options: Any) -> Mesh:
        mesh = Mesh(robot, peer_id, peer_type, parts=self.parts(peer_id, **options))
        self.meshes.append(mesh)
        mesh.start()
        self.meet()
        return mesh

    def meet(self) -> None:
        """Let every peer announce itself once, so that all have seen all."""
        for mesh in self.meshes:
            if mesh.alive:
                mesh.announce()

    def stranger(self) -> MemoryTransport:
        """A session that belongs to no peer."""
        transport = MemoryTransport(self.bus)
        transport.connect()
        return transport

    def events(self, name: str) -> list[dict[str, Any]]:
        return [payload for event, _, payload in self.audit if event == name]

    def close(self) -> None:
        for mesh in self.meshes:
            mesh.close()


@contextmanager
def fleet(folder: Path) -> Iterator[Fleet]:
    peers = Fleet(folder)
    try:
        yield peers
    finally:
        peers.close()
