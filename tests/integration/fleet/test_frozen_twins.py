"""Two robots of one id on Device Connect and on the mesh, one of which is frozen: no stop reports success."""

from __future__ import annotations

import asyncio
import logging
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.nats_server import NatsServer
from fixtures.waiting import accepts, eventually, free_port

from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.profiles import networks_of
from strands_robots.mesh.session import clear_peers

DEVICE = """
import sys
from fixtures.toy_robots import ToyRobot
from strands_robots.device_connect import init_device_connect_sync
from strands_robots.device_connect.backends import LinkConfig
toy = ToyRobot("arm-1")
init_device_connect_sync(toy, peer_id="arm-1", link=LinkConfig(transport="nats", connect=(sys.argv[1],)))
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A robot on Device Connect by NATS, in a process of its own."""
    server = NatsServer().start()
    monkeypatch.setenv("MESSAGING_BACKEND", "nats")
    monkeypatch.setenv("NATS_URL", server.url)
    monkeypatch.setenv("DEVICE_CONNECT_ALLOW_INSECURE", "true")
    monkeypatch.setenv("STRANDS_MESH_PORT", str(free_port()))
    with monkeypatch.context() as env:
        state = tmp_path / "device"
        state.mkdir(mode=0o700)
        env.setenv("STRANDS_STATE_DIR", str(state))
        env.setenv("STRANDS_MESH", "false")
        process = subprocess.Popen(
            [sys.executable, "-c", DEVICE, server.url], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
    try:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready"
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait(30)
        server.kill()


@pytest.fixture
def peer(device: object, tmp_path: Path) -> Iterator[MeshPeer]:
    """A robot of the same id on the mesh."""
    state, port = tmp_path / "peer", free_port()
    state.mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as env:
        env.setenv("STRANDS_MESH_PORT", str(port))
        with MeshPeer("arm-1", "world", {"STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(state)}) as peer:
            eventually(lambda: accepts(port), what="the hub")
            yield peer


@pytest.fixture
def networks(device: object, peer: object) -> Iterator[Networks]:
    with networks_of(None, {}, "tests") as joined:
        assert {each.name for each in joined.settled()} == {DEVICE_CONNECT, MESH}
        yield joined
    clear_peers()


def test_robot_that_is_frozen_on_nats_is_unknown_though_no_one_has_seen_it(
    networks: Networks, device: subprocess.Popen[str], caplog: pytest.LogCaptureFixture
) -> None:
    device.send_signal(signal.SIGSTOP)
    with caplog.at_level(logging.WARNING):
        answers = networks.stop("arm-1", 2.0)
    assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: None, MESH: True}
    assert "refused" not in caplog.text
    assert networks.call("arm-1", "stop", {}, 2.0)["stopped"] is None
    answers = asyncio.run(networks.stop_async("arm-1", 2.0))
    assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: None, MESH: True}


def test_peer_that_was_seen_and_is_gone_is_unknown(networks: Networks, peer: MeshPeer) -> None:
    assert networks.stop("arm-1")[MESH]["stopped"] is True
    peer.kill()
    for answers in (networks.stop("arm-1"), asyncio.run(networks.stop_async("arm-1", 2.0))):
        assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: True, MESH: None}
