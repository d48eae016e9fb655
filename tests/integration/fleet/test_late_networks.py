"""Networks that come later are joined by callers that stay."""

from __future__ import annotations

import subprocess
import sys

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.profiles import networks_of

LOADED = """
import sys
from strands_robots.fleet.profiles import networks_of
with networks_of(None, {"port": int(sys.argv[1])}, "desk", stays=True) as networks:
    networks.find(0.1)
    loaded = {each for each in sys.modules if each.startswith(("strands_robots.mesh", "strands_robots.fleet.mesh."))}
    # This looks for the hub, and loads nothing of the mesh itself.
    print(*(loaded - {"strands_robots.fleet.mesh.config"}))
"""


@pytest.fixture
def no_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_PORT", str(free_port()))


def names(networks: Networks) -> set[str]:
    return {each.name for each in networks.joined}


def test_mesh_is_joined_when_its_hub_comes(no_hub: None) -> None:
    with networks_of(None, {"port": free_port()}, "desk", stays=True) as networks:
        assert names(networks) == {DEVICE_CONNECT}
        assert "no mesh answers" in networks.absent[MESH]
        told: list[str] = []
        networks.on_joined(lambda each: told.append(each.name))
        with MeshPeer("arm-2", "arm", {}):
            eventually(lambda: names(networks) == {DEVICE_CONNECT, MESH}, 30.0, what="the mesh")
            eventually(lambda: "arm-2" in networks.find(), 30.0, what="its robot")
            assert told == [DEVICE_CONNECT, MESH]
            assert MESH not in networks.absent


def test_no_code_of_the_mesh_is_loaded_while_no_hub_answers(no_hub: None) -> None:
    command = [sys.executable, "-c", LOADED, str(free_port())]
    loaded = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    assert loaded.strip() == ""


def test_networks_that_were_left_wait_for_no_hub(no_hub: None) -> None:
    networks = networks_of(None, {}, "desk", devices=False, stays=True)
    with networks:
        assert not networks.joined
    with MeshPeer("arm-2", "arm", {}):
        with networks_of(None, {}, "desk", devices=False, stays=True) as others:
            assert names(others) == {MESH}
        assert not networks.joined


def test_broker_that_is_started_later_is_joined() -> None:
    server = NatsServer()
    networks = networks_of(None, {"nats": [server.url]}, "desk", mesh=False, stays=True)
    with networks:
        assert not networks.joined
        assert "nothing listens there" in networks.absent[DEVICE_CONNECT]
        with server:
            eventually(lambda: names(networks) == {DEVICE_CONNECT}, 30.0, what="the broker")
            assert networks.find(0.5) == {}
