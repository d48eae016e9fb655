"""A fleet with a peer of release 0.5.3, whose ingress drops what follows too quickly."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fixtures.older_mesh_peer import OlderMeshPeer
from fixtures.waiting import eventually, free_port

from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.fleet.mesh.peers import functions_of
from strands_robots.fleet.mesh.stops import ask_peer
from strands_robots.mesh.core import Mesh, Parts
from strands_robots.mesh.session import Pacer, PeerRegistry
from strands_robots.mesh.transport.config import Posture
from strands_robots.mesh.transport.zenoh import ZenohTransport
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.scope import Scope

LINKS = 4
COMMANDS = 200


@pytest.fixture
def older() -> Iterator[tuple[OlderMeshPeer, str]]:
    port = free_port()
    with OlderMeshPeer(port) as peer:
        yield peer, f"tcp/127.0.0.1:{port}"


def console(name: str, hub: str, folder: Path, stack: ExitStack) -> Mesh:
    """A console with a link of its own to the hub, which knows the old peer."""
    transport = ZenohTransport(Posture("strands", (), (), hub, None, None, False, 16))

    def acquire() -> ZenohTransport:
        transport.connect()
        return transport

    plane = SafetyPlane(LockoutStore(folder / name), deadline_s=20.0)
    parts = Parts(acquire=acquire, release=transport.close, registry=PeerRegistry(), pacer=Pacer(), plane=plane)
    mesh = Mesh(None, name, parts=parts)
    stack.callback(mesh.close)
    mesh.start()
    eventually(lambda: mesh.get_peer("old-1") is not None)
    return mesh


def test_every_command_is_answered_each_way(older: tuple[OlderMeshPeer, str], tmp_path: Path) -> None:
    peer, hub = older
    answers: list[str] = []
    with ExitStack() as stack:
        consoles = [console(f"console-{number}", hub, tmp_path, stack) for number in range(LINKS)]

        def ask(mesh: Mesh) -> None:
            for number in range(COMMANDS // LINKS):
                action = "stop" if number % 2 else "ping"
                answers.append(mesh.send("old-1", {"action": action}, 20).get("type", "none"))

        asking = [threading.Thread(target=ask, args=(mesh,)) for mesh in consoles]
        for thread in asking:
            thread.start()
        asked = peer.ask([mesh.peer_id for mesh in consoles], COMMANDS // LINKS)
        for thread in asking:
            thread.join(60)
    assert answers == ["response"] * COMMANDS
    assert len(asked) == COMMANDS


def test_older_peer_halts_and_locks_although_its_answer_closes_the_stop_at_once(
    older: tuple[OlderMeshPeer, str], tmp_path: Path
) -> None:
    peer, hub = older
    with ExitStack() as stack:
        mesh = console("console", hub, tmp_path, stack)
        replies = mesh.emergency_stop()
        assert [each["responder_id"] for each in replies] == ["old-1"]
        assert peer.halts
        mesh.close()  # a command line that ends now still sends the envelope that locks
        assert eventually(lambda: peer.locked)


def test_no_question_has_a_field_that_an_older_peer_refuses(older: tuple[OlderMeshPeer, str], tmp_path: Path) -> None:
    peer, hub = older
    with ExitStack() as stack:
        mesh = console("console", hub, tmp_path, stack)
        questions: list[dict[str, Any]] = [
            {"action": "status"},
            {"action": "status", "nonce": ""},
            {"action": "status", "nonce": 32 * "a"},
            {"action": "teleop_stop"},
            {"action": "teleop_stop", "source_peer_id": "lead-1", "device_name": "leader"},
            *({"action": action} for action in ("features", "state", "teleop_status", "ping", "stop")),
        ]
        for question in questions:
            assert mesh.send("old-1", question, 20)["type"] == "response", question
            assert [each["type"] for each in mesh.broadcast(question, 0.5)] == ["response"], question
        assert ask_peer(mesh, "old-1", 20.0, {"old-1": bytes(32)}).problem == "it does not report lockouts"
        mesh.emergency_stop(scope=Scope(only=frozenset({"old-1"})))
        assert not peer.refused


def test_a_caller_asks_an_older_peer_for_no_description_and_knows_its_actions(
    older: tuple[OlderMeshPeer, str], tmp_path: Path
) -> None:
    peer, hub = older
    with ExitStack() as stack:
        network = MeshNetwork.joined(console("console", hub, tmp_path, stack))
        stack.callback(network.close)
        announced = network.announced_functions("old-1")
        assert isinstance(announced, list)
        names = {each["name"] for each in announced}
        assert {"status", "stop", "execute", "start", "teleop_receive"} <= names
        assert names.isdisjoint({"describe", "acquireControl", "getControl", "moveTo"})
        assert functions_of(network.peer, "old-1", 5.0) is None
        assert asyncio.run(network.describe_async("old-1", 5.0)).functions == announced
        assert not any("lease" in name for each in announced for name in each["parameters"]["properties"])
        assert not peer.refused
