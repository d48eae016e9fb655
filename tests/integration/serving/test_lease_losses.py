"""A holder that crashes, or is cut off, leaves the robot halted, free and not locked."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually

from strands_robots.device_connect import FleetClient, LinkConfig, init_device_connect_sync, stop_device_connect

TTL_S = 1.5


@pytest.fixture
def server() -> Iterator[NatsServer]:
    with NatsServer() as running:
        yield running


@pytest.fixture
def robot(server: NatsServer, monkeypatch: pytest.MonkeyPatch) -> Iterator[ToyRobot]:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    toy = ToyRobot("arm")
    runtime = init_device_connect_sync(
        toy, peer_id="arm-1", link=LinkConfig(transport="nats", connect=(server.url,)), allow_insecure=True
    )
    yield toy
    stop_device_connect(runtime)
    toy.close()


@pytest.fixture
def holder(server: NatsServer, robot: ToyRobot) -> Iterator[Child]:
    with Child("fixtures.lease_holder", {"url": server.url, "device": "arm-1", "ttl_s": TTL_S}) as child:
        eventually(lambda: child.ask("acquire").get("lease_id"), what="the lease")
        assert child.ask("execute")["status"] == "success"
        assert moving(robot)
        yield child


def moving(robot: ToyRobot) -> bool:
    return any(each.running for each in robot.rollouts.values())


def other(server: NatsServer) -> FleetClient:
    return FleetClient(LinkConfig(transport="nats", connect=(server.url,)), "agent-b")


def test_robot_of_an_agent_that_was_killed_is_halted_and_free(
    server: NatsServer, robot: ToyRobot, holder: Child
) -> None:
    holder.kill()
    with other(server) as second:
        refused = second.call("arm-1", "acquireControl")
        assert (refused["code"], refused["holder"]) == ("not_holder", "agent-a")
        eventually(lambda: not moving(robot), within=TTL_S + 5.0, what="the halt")
        status = second.call("arm-1", "getStatus")
        assert (status["control"]["held"], status["locked"]) == (False, False)
        assert second.call("arm-1", "acquireControl", {"ttl_s": 0.5})["status"] == "success"


def test_partition_halts_the_robot_by_itself_and_voids_the_lease(
    server: NatsServer, robot: ToyRobot, holder: Child
) -> None:
    server.kill()
    eventually(lambda: not moving(robot), within=TTL_S + 5.0, what="the halt without a network")
    server.start()
    with other(server) as second:
        eventually(second.peers, what="the robot after the partition")
        assert second.call("arm-1", "getStatus")["control"]["held"] is False
    late = eventually(lambda: answered(holder), what="the holder's answer after the partition")
    assert (late["status"], late["code"]) == ("error", "lease_over")
    assert not moving(robot)


def answered(holder: Child) -> dict[str, object]:
    try:
        answer: dict[str, object] = holder.ask("execute")
    except AssertionError:
        return {}
    return answer
