"""Clocks and peers on the in-memory transport, for the tests of this folder."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from strands_robots.mesh.core import Mesh, Parts
from strands_robots.mesh.session import PeerRegistry
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
from strands_robots.mesh.wire_identity import INPUT, ConsoleSigner, Identity
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane

Message = dict[str, Any]


class Clock:
    """Seconds that pass only when a test says so, from the real time on."""

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


class PartedBus(MemoryBus):
    """A bus from which a session can be cut off."""

    def __init__(self) -> None:
        super().__init__()
        self._cut: set[MemoryTransport] = set()

    def parted(self, one: MemoryTransport, other: MemoryTransport) -> bool:
        return one is not other and not self._cut.isdisjoint((one, other))

    def partition(self, transport: MemoryTransport, cut: bool = True, *, stayed: bool = False) -> None:
        """Lose every message from and to a session; ``cut=False`` heals it.

        Args:
            stayed: it is told that others of its links were up all the time.
        """
        if not cut and transport in self._cut and isinstance(transport, PartedTransport):
            transport.stayed += stayed
            transport.healed += 1
        (self._cut.add if cut else self._cut.discard)(transport)


class PartedTransport(MemoryTransport):
    """A session that counts how often its links came back, and at how many of these others had stayed."""

    healed = stayed = 0

    def links_back(self) -> int:
        return self.healed

    def rejoined(self) -> int:
        return self.healed - self.stayed


class Fleet:
    """Peers of one process, each with a session, registry and plane of its own."""

    def __init__(self, folder: Path, clock: Clock | None = None) -> None:
        self.bus = PartedBus()
        self.clock = clock or Clock()
        self.meshes: list[Mesh] = []
        self.transports: dict[str, MemoryTransport] = {}
        self.audit: list[tuple[str, str, dict[str, Any]]] = []
        self.planes: dict[str, SafetyPlane] = {}
        self._folder = folder

    def parts(
        self, peer_id: str, *, identity: Identity | None = None, sessionless: bool = False, keep: bool = False
    ) -> Parts:
        transport = PartedTransport(self.bus, sessionless=sessionless)
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
            keep=keep,
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


def received(peers: Fleet, key: str) -> list[Message]:
    """The messages on a key from now on; the list grows as they arrive."""
    messages: list[Message] = []
    peers.stranger().declare_subscriber(key, lambda sample: messages.append(json.loads(sample.payload)))
    return messages


def signed(peers: Fleet, frame: Message) -> Message:
    """An input frame with the signature of this user's console."""
    return ConsoleSigner(peers.clock).sign(frame, INPUT)


class ScriptedPeer:
    """A peer that serves one command of a turn and answers after ``seconds``."""

    def __init__(
        self,
        peers: Fleet,
        name: str,
        seconds: float,
        first: dict[str, Any] | None = None,
        always: dict[str, Any] | None = None,
    ) -> None:
        self.name, self.seconds, self.first, self.always = name, seconds, first, always
        self.turns: list[str] = []
        self.threads: list[threading.Timer] = []
        self.wire = peers.stranger()
        self.wire.put(f"strands/{name}/presence", {"robot_id": name, "timestamp": peers.clock()})
        for key in ("strands/broadcast", f"strands/{name}/cmd"):
            self.wire.declare_subscriber(key, self.on_command)

    def on_command(self, sample: Any) -> None:
        body = json.loads(sample.payload)
        again = body["turn_id"] in self.turns
        first = self.first if not self.turns else None
        first = self.always or first
        self.turns.append(body["turn_id"])
        head = {"responder_id": self.name, "turn_id": body["turn_id"], "timestamp": body["timestamp"]}
        key = f"strands/{body['sender_id']}/response/{self.name}/{body['turn_id']}"
        if again:
            self.wire.put(key, {**head, "type": "error", "error": "replay"})
            return
        said = first or {"type": "response", "result": {"ok": True}}
        late = threading.Timer(self.seconds if first is None else 0.0, lambda: self.wire.put(key, {**head, **said}))
        self.threads.append(late)
        late.start()

    def join(self) -> None:
        for each in self.threads:
            each.join(20)
