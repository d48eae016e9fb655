"""Two agents and a human at one robot, over Device Connect: one holds it, one is refused, one takes it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.client import DeviceEvent
from strands_robots.safety.ed25519 import keygen

STRONG = "Plenty of 4 different words"


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def link(port: int) -> LinkConfig:
    return loopback_config(port)


@pytest.fixture
def robot(link: LinkConfig, monkeypatch: pytest.MonkeyPatch) -> Iterator[ToyRobot]:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    toy = ToyRobot("arm")
    runtime = init_device_connect_sync(toy, peer_id="arm-1", link=link)
    yield toy
    stop_device_connect(runtime)
    toy.close()


@pytest.fixture
def first(link: LinkConfig, robot: ToyRobot) -> Iterator[FleetClient]:
    with FleetClient(link, "agent-a") as client:
        eventually(client.peers)
        yield client


@pytest.fixture
def second(link: LinkConfig, robot: ToyRobot) -> Iterator[FleetClient]:
    with FleetClient(link, "agent-b") as client:
        eventually(client.peers)
        yield client


def moving(robot: ToyRobot) -> bool:
    return any(each.running for each in robot.rollouts.values())


def test_agent_that_does_not_hold_the_robot_is_refused_by_name(
    first: FleetClient, second: FleetClient, robot: ToyRobot
) -> None:
    held = first.call("arm-1", "acquireControl", {"ttl_s": 60.0})
    refused = second.call("arm-1", "execute", {"instruction": "wave"})
    assert (refused["status"], refused["code"], refused["holder"]) == ("error", "not_holder", "agent-a")
    assert 0 < refused["expires_in_s"] <= 60
    assert not moving(robot)
    started = first.call("arm-1", "execute", {"instruction": "wave", "lease_id": held["lease_id"], "duration": 300.0})
    assert started["status"] == "success"
    assert second.call("arm-1", "getStatus")["control"]["holder"] == "agent-a"
    assert second.stop("arm-1", 10.0)["status"] == "success"
    assert not moving(robot)


def test_motion_of_one_agent_keeps_out_the_other_until_it_has_ended(first: FleetClient, second: FleetClient) -> None:
    assert first.call("arm-1", "execute", {"instruction": "wave", "duration": 300.0})["status"] == "success"
    assert second.call("arm-1", "execute", {"instruction": "wave"})["code"] == "not_holder"
    first.stop("arm-1", 10.0)
    eventually(lambda: second.call("arm-1", "acquireControl")["status"] == "success")


def test_agent_that_falls_silent_is_halted_and_the_robot_is_free(
    first: FleetClient, second: FleetClient, robot: ToyRobot
) -> None:
    events: list[DeviceEvent] = []
    with second.subscription("arm-1", events.append):
        held = first.call("arm-1", "acquireControl", {"ttl_s": 1.0})
        first.call("arm-1", "execute", {"instruction": "wave", "lease_id": held["lease_id"], "duration": 300.0})
        assert moving(robot)
        first.close()
        eventually(lambda: not moving(robot))
        eventually(lambda: any(each.name == "controlExpired" for each in events))
    status = second.call("arm-1", "getStatus")
    assert status["control"]["held"] is False
    assert status["locked"] is False


def test_operator_takes_the_robot_by_key_from_an_agent(
    first: FleetClient, robot: ToyRobot, port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, passphrase = tmp_path / "operator.pem", tmp_path / "passphrase"
    public = keygen(key, STRONG)
    passphrase.write_text(STRONG)
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", public)
    held = first.call("arm-1", "acquireControl")
    first.call("arm-1", "execute", {"instruction": "wave", "lease_id": held["lease_id"], "duration": 300.0})
    at = ("--port", str(port), "--json")

    without = CliRunner().invoke(build(), ["take", "arm-1", *at])
    assert without.exit_code == 1, without.output
    assert moving(robot)

    signed = ["take", "arm-1", "--key", str(key), "--passphrase-file", str(passphrase), *at]
    taken = CliRunner().invoke(build(), signed)
    assert taken.exit_code == 0, taken.output
    assert not moving(robot)
    lost = first.call("arm-1", "execute", {"instruction": "wave", "lease_id": held["lease_id"]})
    assert (lost["code"], lost["holder"]) == ("displaced", "strands-robots")
    lease_id = json.loads(taken.output)["lease_id"]
    assert first.call("arm-1", "releaseControl", {"lease_id": lease_id})["status"] == "success"


@pytest.mark.parametrize("ttl_s", [True, 0.1, 1e9, "60"])
def test_time_out_of_its_domain_is_refused_by_name(first: FleetClient, ttl_s: object) -> None:
    answer = first.call("arm-1", "acquireControl", {"ttl_s": ttl_s})
    assert answer["status"] == "error"
    assert first.call("arm-1", "getControl")["held"] is False
