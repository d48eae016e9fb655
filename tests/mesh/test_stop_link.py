"""The link of the mesh's stops: who may open it, what else brings stops, and who leaves it."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh import safety, topics
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.resume_authority import keygen, load_signing_key
from strands_robots.mesh.stop_link import MeshStopLink
from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.transport.bridge import BridgeTransport
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
from strands_robots.safety.orders import signed_stop
from strands_robots.safety.statements import Purpose

PASSPHRASE = "Correct-Horse-7-Battery"


@pytest.fixture
def stop_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The key of a console; robots that join demand its signature."""
    monkeypatch.setattr(safety, "COLLECT_S", 1.0)
    public = keygen(tmp_path / "stop.pem", PASSPHRASE)
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", public)
    monkeypatch.setenv("STRANDS_ESTOP_REQUIRE_SIGNED", "true")
    return load_signing_key(tmp_path / "stop.pem", PASSPHRASE)


class ApartTransport(MemoryTransport):
    """A local leg whose connection for stops is up, as Zenoh's is beside any other process."""

    @property
    def stops_up(self) -> bool:
        return True


@pytest.fixture
def cloud() -> MemoryTransport:
    """What other clients of the broker send with."""
    client = MemoryTransport(MemoryBus(), sessionless=True)
    client.connect()
    return client


@pytest.fixture
def bridged(peers: Fleet, cloud: MemoryTransport, stop_key: Any, monkeypatch: pytest.MonkeyPatch) -> Mesh:
    """A robot on both legs of a bridge."""
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "60")
    monkeypatch.setenv("STRANDS_MESH_BRIDGE_TOPICS", "presence,estop,resume,checkin,cmd,broadcast,response")
    both = BridgeTransport(ApartTransport(MemoryBus()), MemoryTransport(cloud.bus, sessionless=True))

    def acquire() -> BridgeTransport:
        both.connect()
        return both

    mesh = Mesh(Arm(), "arm-1", "robot", parts=replace(peers.parts("arm-1"), acquire=acquire, release=both.close))
    peers.meshes.append(mesh)
    mesh.start()
    return mesh


def _signed(key: Any, purpose: Purpose) -> bytes:
    fields = {"peer_id": "console", "estop_id": "ab" * 16, "t": time.time(), "nonce": "cd" * 16}
    return json.dumps(signed_stop(key, purpose, "console", fields)).encode()


@pytest.mark.parametrize("sender", ["mallory", "mallory-{}"])
def test_forged_stops_over_a_broker_hide_no_true_one(
    bridged: Mesh, cloud: MemoryTransport, stop_key: Any, sender: str
) -> None:
    for number in range(150):
        forged = {"peer_id": sender.format(number), "estop_id": f"{number:032x}", "t": time.time(), "nonce": "ef" * 16}
        cloud.put(topics.estop(), json.dumps({**forged, "sig": "A" * 86}).encode())
    assert bridged.lockout_epoch is None
    cloud.put(topics.estop(), _signed(stop_key, Purpose.EMERGENCY_STOP))
    assert bridged.lockout_epoch == "ab" * 16


def test_check_ins_over_a_broker_count_while_the_local_connection_for_stops_is_up(
    bridged: Mesh, cloud: MemoryTransport, stop_key: Any, peers: Fleet
) -> None:
    cloud.put(topics.check_in("console"), _signed(stop_key, Purpose.CHECK_IN))
    eventually(lambda: "console" in peers.planes["arm-1"].checkin.fields(0.0)["controllers"])


def test_a_console_without_public_keys_stops_robots_that_demand_signatures(
    peers: Fleet, stop_key: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = peers.join(Arm(), "arm-1")
    monkeypatch.delenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")
    console = peers.join(None, "console")
    peers.meet()
    answers = console.emergency_stop(stop_key)
    assert arm.lockout_epoch is not None
    assert {each["responder_id"] for each in answers} == {"arm-1"}


def test_a_console_without_public_keys_checks_in(peers: Fleet, stop_key: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "60")
    peers.join(Arm(), "arm-1")
    monkeypatch.delenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")
    console = peers.join(None, "console")
    console.check_in_every(0.05, stop_key)
    eventually(lambda: "console" in peers.planes["arm-1"].checkin.fields(0.0)["controllers"])


def test_a_robot_that_leaves_is_stopped_for_as_long_as_it_serves_commands(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = peers.join(Arm(), "arm-1")
    closing, go_on = threading.Event(), threading.Event()
    close = MeshStopLink.close

    def slow_close(link: MeshStopLink) -> None:
        closing.set()
        assert go_on.wait(30)
        close(link)

    monkeypatch.setattr(MeshStopLink, "close", slow_close)
    assert topics.command("arm-1") in _subscribed(peers, "arm-1")
    leaving = threading.Thread(target=arm.stop)
    leaving.start()
    try:
        assert closing.wait(30)
        assert topics.command("arm-1") not in _subscribed(peers, "arm-1")
    finally:
        go_on.set()
        leaving.join()


def _subscribed(peers: Fleet, peer: str) -> set[str]:
    return {each.key for each in peers.bus.declared_by(peers.transports[peer])}


def test_a_link_that_could_not_be_opened_is_opened_with_the_next_stop(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    peers.meet()
    transport, asked = peers.transports["console"], topics.missed_ask("*")
    declare, tried = transport.declare_subscriber, list[str]()

    def fail_once(key: str, callback: Any) -> Any:
        tried.append(key)
        if key == asked and tried.count(asked) == 1:
            raise TransportError("no leg of the bridge is connected.")
        return declare(key, callback)

    monkeypatch.setattr(transport, "declare_subscriber", fail_once)
    console.emergency_stop()
    assert tried.count(asked) == 1
    console.emergency_stop()
    assert tried.count(asked) == 2
