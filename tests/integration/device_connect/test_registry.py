"""Robots in registry mode, with the framework's own registry service and etcd, on NATS and on Zenoh."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import Machine
from fixtures.echo_device import EchoDevice
from fixtures.nats_server import NatsServer
from fixtures.registry_service import Etcd, RegistryService
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect import FleetClient, LinkConfig, init_device_connect_sync, stop_device_connect
from strands_robots.safety.plane import plane
from strands_robots.tools import robot_mesh

pytestmark = pytest.mark.system
EVERYONE = ["arm-1", "arm-2", "bare-1"]


@dataclass
class Site:
    """Two of our arms, one bare device, the registry, and a machine with our command line."""

    link: LinkConfig
    environment: dict[str, str]
    worlds: dict[str, ToyWorld]
    etcd: Etcd
    registry: RegistryService
    machine: Machine

    def move(self) -> None:
        """Start a motion of both arms."""
        with FleetClient(self.link) as fleet:
            for name, world in self.worlds.items():
                assert fleet.call(name, "execute", {"instruction": "wave", "duration": 600})["status"] == "success"
                assert world.rollouts["left"].running

    @property
    def moving(self) -> list[str]:
        """Arms that move."""
        return [name for name, world in self.worlds.items() if world.rollouts["left"].running]


@pytest.fixture(scope="module", params=["nats", "zenoh"])
def network(request: pytest.FixtureRequest) -> Iterator[tuple[LinkConfig, dict[str, str], Etcd, RegistryService]]:
    with ExitStack() as stack:
        if request.param == "nats":
            url = stack.enter_context(NatsServer()).url
            variables = {"NATS_URL": url, "MESSAGING_BACKEND": "nats"}
            link = LinkConfig("nats", connect=(url,))
        else:
            endpoint = stack.enter_context(ZenohRouter()).endpoint
            variables = {"ZENOH_CONNECT": endpoint, "MESSAGING_BACKEND": "zenoh"}
            link = LinkConfig(connect=(endpoint,))
        etcd = stack.enter_context(Etcd())
        registry = stack.enter_context(RegistryService(etcd, variables))
        yield link, variables, etcd, registry


@pytest.fixture
def site(network: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    link, variables, etcd, registry = network
    environment = {**variables, "DEVICE_CONNECT_ALLOW_INSECURE": "true"}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("DEVICE_CONNECT_DISCOVERY_MODE", "registry")
    worlds = {name: ToyWorld(name) for name in ("arm-1", "arm-2")}
    with EchoDevice("bare-1", environment=environment):
        runtimes = [
            init_device_connect_sync(world, peer_id=name, link=link, allow_insecure=True)
            for name, world in worlds.items()
        ]
        # A console need not know how the robots are discovered.
        monkeypatch.delenv("DEVICE_CONNECT_DISCOVERY_MODE")
        with FleetClient(link) as fleet:
            eventually(lambda: [peer.id for peer in fleet.peers()] == EVERYONE, within=60.0)
        yield Site(link, environment, worlds, etcd, registry, Machine(tmp_path, **environment))
        for runtime in runtimes:
            stop_device_connect(runtime)
    for world in worlds.values():
        world.close()


def test_every_tool_finds_the_robots_that_the_registry_lists(site: Site) -> None:
    listed = site.registry.devctl("list", "--compact")
    assert all(f"{name}\n" in listed for name in EVERYONE)
    code, said = site.machine.json("peers")
    assert (code, [peer["id"] for peer in said["peers"]], said["stale"]) == (0, EVERYONE, "")
    code, said = site.machine.json("lockout")
    assert (code, sorted(said["live"])) == (0, ["arm-1", "arm-2"])
    assert [peer["id"] for peer in robot_mesh(action="peers")["peers"]] == EVERYONE


def test_stop_all_stops_every_robot_that_the_registry_lists(site: Site) -> None:
    site.move()
    code, said = site.machine.json("stop", "--all")
    assert (code, sorted(said["devices"])) == (0, EVERYONE)
    assert not site.moving
    site.move()
    assert robot_mesh(action="stop")["stopped"] is True
    assert not site.moving


def test_estop_without_names_names_every_robot_that_the_registry_lists(site: Site) -> None:
    site.move()
    code, said = site.machine.json("estop")
    assert not site.moving
    assert sorted(said["stopped"]) == EVERYONE
    # The bare device knows nothing of emergency stops; a plain stop halts it.
    assert (code, said["silent"], said["not_locked"]) == (3, [], ["bare-1"])
    assert site.machine.json("lockout")[1]["live"]["arm-1"]["locked"]

    def shown() -> dict[str, Any]:
        return {row["id"]: row.get("locked") for row in robot_mesh(action="peers")["peers"]}

    # The registry learns it from a heartbeat.
    eventually(lambda: shown() == {"arm-1": True, "arm-2": True, "bare-1": None}, what="the lockouts")
    plane().clear_local("the test")
    eventually(lambda: shown() == {"arm-1": False, "arm-2": False, "bare-1": None}, what="the free robots")


def test_events_of_every_robot_in_registry_mode_are_received(site: Site) -> None:
    ready, seen = threading.Event(), set()
    with FleetClient(site.link) as fleet:
        for event in fleet.events("*", timeout=60, ready=ready):
            seen.add(event.device)
            if seen >= {"arm-1", "arm-2"}:
                break
    assert seen >= {"arm-1", "arm-2"}


@pytest.mark.parametrize("gone", ["service", "database"])
def test_outage_of_the_registry_leaves_robots_calls_and_stops_alone(site: Site, gone: str) -> None:
    part = site.registry if gone == "service" else site.etcd
    with FleetClient(site.link) as fleet:
        assert [peer.id for peer in fleet.peers()] == EVERYONE
        site.move()
        part.kill()
        try:
            assert fleet.call("arm-1", "getStatus")["status"] == "success"
            assert [peer.id for peer in fleet.peers()] == EVERYONE
            assert "registry gives no list" in fleet.stale
            assert site.moving == ["arm-1", "arm-2"]
            site.machine.environment["DEVICE_CONNECT_DISCOVERY_MODE"] = "registry"
            code, said = site.machine.json("stop", "--all")
            assert not site.moving
            assert (code, sorted(said["devices"])) == (3, EVERYONE)
            assert "registry gives no list" in said["reason"]
            code, said = site.machine.json("estop")
            # Whether the bare device is found depends on the list that the registry gave last.
            assert (code, said["stopped"].keys() - {"bare-1"}) == (3, {"arm-1", "arm-2"})
            assert "could not be looked up" in said["reason"]
        finally:
            part.start()
        eventually(lambda: [peer.id for peer in fleet.peers()] == EVERYONE and not fleet.stale, within=90.0)
