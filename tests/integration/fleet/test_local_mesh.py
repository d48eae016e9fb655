"""The mesh of this machine beside Device Connect at the same port, and commands that load none of its code."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.older_mesh_peer import OlderMeshPeer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots import connect
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.mesh.config import BROADCAST, LocalMesh, no_hub, no_peers
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.mesh import topics
from strands_robots.mesh.session import clear_peers

LOADED = """
import sys
from strands_robots import connect
with connect() as fleet:
    print([robot.id for robot in fleet.robots()], fleet["arm-1"].status()["status"])
print([name for name in sys.modules if name.startswith("strands_robots.mesh")])
"""


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The port of both networks, as it is one by default."""
    port = free_port()
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(port))
    yield port
    clear_peers()


@pytest.fixture
def arm(port: int) -> Iterator[ToyRobot]:
    """A robot on Device Connect."""
    toy = ToyRobot("toy")
    runtime = init_device_connect_sync(toy, peer_id="arm-1", link=loopback_config(port))
    yield toy
    stop_device_connect(runtime)
    toy.close()


@pytest.fixture
def peer(port: int, tmp_path: Path) -> Iterator[MeshPeer]:
    state = tmp_path / "far"
    state.mkdir(mode=0o700)
    with MeshPeer("arm-2", "world", {"STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(state)}) as peer:
        yield peer


def test_topic_that_is_looked_for_is_the_one_that_peers_receive() -> None:
    assert topics.broadcast() == BROADCAST


def test_port_that_no_one_has_is_no_mesh(port: int) -> None:
    assert no_hub() == f"no mesh answers on 127.0.0.1:{port}"
    with pytest.raises(UnreachableError, match="no mesh answers"):
        LocalMesh(lambda: MeshNetwork("console")).open()


def test_device_connect_alone_at_the_port_is_no_mesh_and_loads_none_of_its_code(arm: ToyRobot) -> None:
    assert no_hub() == ""
    assert "no peer of a mesh is behind" in no_peers()
    said = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, timeout=120, check=True)
    assert said.stdout.splitlines() == ["['arm-1'] success", "[]"]


@pytest.mark.usefixtures("arm", "peer")
def test_peer_behind_the_port_of_device_connect_is_found() -> None:
    eventually(lambda: no_peers() == "", what="the peer's subscription")
    with connect() as fleet:
        found = eventually(lambda: len(fleet.robots()) == 2 and fleet.robots(), what="both robots")
        assert {robot.id: robot.network for robot in found} == {"arm-1": DEVICE_CONNECT, "arm-2": MESH}


def test_peer_of_an_earlier_release_is_found(port: int) -> None:
    with OlderMeshPeer(port):
        eventually(lambda: no_peers() == "", what="the peer's subscription")


def test_hub_that_hangs_is_given_up_in_a_second(peer: MeshPeer) -> None:
    eventually(lambda: no_peers() == "", what="the peer's subscription")
    peer.signal(signal.SIGSTOP)
    try:
        began = time.monotonic()
        assert no_peers() != ""
        assert time.monotonic() - began < 5.0
    finally:
        peer.signal(signal.SIGCONT)


def test_mesh_that_is_not_joined_has_a_name_and_no_robots(port: int) -> None:
    mesh = LocalMesh(lambda: MeshNetwork("console"))
    assert (mesh.name, str(port) in mesh.key.text) == (MESH, True)
    with pytest.raises(UnreachableError, match="not joined"):
        mesh.find()
    mesh.close()
