"""Robots, clocks and peers on the in-memory transport, for the tests of this folder."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from strands_robots.contract import Observer, Unsubscribe
from strands_robots.envelope import Envelope, error, success
from strands_robots.mesh.assembly import Parts
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.registry import PeerRegistry
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
from strands_robots.mesh.wire_identity import Identity
from strands_robots.safety.gate import MotionGate, MotionRefused
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.stopping import StopVerdict


class Clock:
    """Seconds that pass only when told to, from the real time on."""

    def __init__(self) -> None:
        self.at = time.time()

    def __call__(self) -> float:
        return self.at

    def pass_(self, seconds: float) -> None:
        self.at += seconds


class Arm:
    """A robot of one body that records what it was asked."""

    def __init__(self, name: str = "arm", *, stops: bool = True) -> None:
        self.tool_name_str = name
        self.gate = MotionGate()
        self.stops = stops
        self.moving = False
        self.started: list[str] = []
        self.halts: list[str] = []
        self.actions: list[dict[str, float]] = []

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        try:
            self.gate.permit("start_task")
        except MotionRefused as refused:
            return refused.envelope
        self.started.append(instruction)
        self.moving = duration > 1
        return success("started")

    def stop_task(self) -> Envelope:
        self.moving = False
        return success("stopped")

    def get_task_status(self) -> Envelope:
        return success("status", task_status="running" if self.moving else "idle", instruction="", step_count=0)

    def get_features(self) -> Envelope:
        return success("features", observation_features={}, action_features={"shoulder.pos": "float"})

    def get_state(self) -> Envelope:
        return success("state", joints={"shoulder": 1.5}, task={})

    def send_action(self, action: dict[str, float]) -> Envelope:
        self.actions.append(dict(action))
        return success("sent") if "broken" not in action else error("no such joint")

    def subscribe(self, observer: Observer) -> Unsubscribe:
        return lambda: None

    def halt(self, reason: str = "") -> StopVerdict:
        self.gate.revoke()
        self.halts.append(reason)
        if not self.stops:
            return StopVerdict(not_stopped={self.tool_name_str: "the brake is stuck"})
        self.moving = False
        return StopVerdict(halted=("task",))


class World:
    """A simulated world with as many robots as it is given."""

    def __init__(self, *names: str) -> None:
        self.tool_name_str = "world"
        self.gate = MotionGate()
        self.names = list(names)
        self.running: dict[str, str] = {}
        self.steps = 0

    def list_robots(self) -> list[str]:
        return list(self.names)

    def start_policy(
        self, robot_name: str, instruction: str, policy_provider: str = "mock", duration: float = 30.0, **policy: Any
    ) -> Envelope:
        self.running[robot_name] = instruction
        return success("started", robot=robot_name, policy=policy)

    def stop_policy(self, robot_name: str) -> Envelope:
        self.running.pop(robot_name, None)
        return success("stopped", stopped=True)

    def list_policies_running(self) -> list[dict[str, Any]]:
        return [{"robot": name, "instruction": words, "step": 3} for name, words in self.running.items()]

    def get_state(self) -> Envelope:
        return success("state", sim_time=1.25, step_count=5, robots={name: {"joint": 0.5} for name in self.names})

    def get_features(self) -> Envelope:
        return success("features")

    def step(self, n: int = 1) -> Envelope:
        self.steps += n
        return success("stepped")

    def reset(self) -> Envelope:
        self.steps = 0
        return success("reset")

    def subscribe(self, observer: Observer) -> Unsubscribe:
        return lambda: None

    def halt(self, reason: str = "") -> StopVerdict:
        self.gate.revoke()
        names, self.running = tuple(self.running), {}
        return StopVerdict(halted=names)


class Fleet:
    """Peers in one process, each as if alone in a process of its own: own session, registry and safety plane."""

    def __init__(self, folder: Path) -> None:
        self.bus = MemoryBus()
        self.clock = Clock()
        self.meshes: list[Mesh] = []
        self.transports: dict[str, MemoryTransport] = {}
        self.audit: list[tuple[str, str, dict[str, Any]]] = []
        self._folder = folder

    def parts(self, peer_id: str, *, identity: Identity | None = None, sessionless: bool = False) -> Parts:
        transport = MemoryTransport(self.bus, sessionless=sessionless)
        self.transports[peer_id] = transport

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
            plane=SafetyPlane(LockoutStore(self._folder / peer_id)),
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
