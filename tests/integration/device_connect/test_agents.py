"""Agents find, drive, follow and stop our devices with the framework's own tools, unchanged."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import device_connect_agent_tools as agent_tools
import pytest
from device_connect_agent_tools.adapters import strands as strands_tools
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import eventually, eventually_async, free_port
from strands import Agent

from strands_robots.device_connect import LinkConfig, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.testing import ScriptedModel

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


class Lab:
    """Two worlds and one hardware robot on one network, and the environment an agent needs to reach it."""

    def __init__(self, link: LinkConfig, environment: dict[str, str]) -> None:
        self.environment = {**environment, "DEVICE_CONNECT_DISCOVERY_MODE": "d2d"}
        self.worlds = {"arm-1": ToyWorld("one"), "arm-2": ToyWorld("two")}
        self.robot = ToyRobot("metal")
        bodies: dict[str, Any] = {**self.worlds, "metal-1": self.robot}
        self.runtimes = [init_device_connect_sync(body, peer_id=name, link=link) for name, body in bodies.items()]

    def close(self) -> None:
        for runtime in self.runtimes:
            stop_device_connect(runtime)
        for body in (*self.worlds.values(), self.robot):
            body.close()

    def still(self) -> None:
        for world in self.worlds.values():
            world.halt()


@pytest.fixture(scope="module", params=["zenoh", "nats"])
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    if request.param == "zenoh":
        port = free_port()
        made = Lab(loopback_config(port), {"ZENOH_CONNECT": f"tcp/127.0.0.1:{port}"})
        yield made
        made.close()
        return
    with NatsServer() as server:
        link = LinkConfig(transport="nats", connect=(server.url,))
        made = Lab(link, {"NATS_URL": server.url, "MESSAGING_BACKEND": "nats"})
        yield made
        made.close()


@pytest.fixture
def connected(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    for name, value in lab.environment.items():
        monkeypatch.setenv(name, value)
    agent_tools.connect()
    eventually(lambda: len(agent_tools.discover_devices(refresh=True)) == 3)
    yield lab
    agent_tools.disconnect()
    lab.still()


def test_agents_discover_all_devices(connected: Lab) -> None:
    rows = {row["device_id"]: row for row in agent_tools.discover_devices()}
    assert set(rows) == {"arm-1", "arm-2", "metal-1"}
    assert [r["device_id"] for r in agent_tools.discover_devices(device_type="strands_robot")] == ["metal-1"]
    fleet = agent_tools.describe_fleet()
    assert "strands_sim" in json.dumps(fleet)
    described = json.dumps(agent_tools.discover("device(arm-1)"))
    assert "Start a policy on a simulated robot" in described


def test_agents_drive_and_stop(connected: Lab) -> None:
    world = connected.worlds["arm-1"]
    answer = agent_tools.invoke_device("arm-1", "execute", {"instruction": "wave"})
    assert answer["result"]["status"] == "success"
    assert answer["result"]["robot_name"] == "left"
    eventually(lambda: world.rollouts["left"].steps > 3)
    stopped = agent_tools.invoke("device(arm-1).function(stop)")
    assert "left" in json.dumps(stopped)
    assert not world.rollouts["left"].running


def test_agent_without_a_name_does_not_move_hardware_and_may_stop_it(connected: Lab) -> None:
    answer = agent_tools.invoke_device("metal-1", "execute", {"instruction": "wave"})["result"]
    assert answer["status"] == "error"
    assert "DEVICE_CONNECT_RPC_ALLOW" in answer["reason"]
    assert agent_tools.invoke_device("metal-1", "stop")["result"]["status"] == "success"
    assert agent_tools.invoke_device("metal-1", "getStatus")["result"]["task_status"] == "idle"


def test_hardware_moves_for_an_unnamed_agent_with_the_operators_approval(
    connected: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "anonymous")
    answer = agent_tools.invoke_device("metal-1", "execute", {"instruction": "wave"})["result"]
    assert "operator approval" in answer["reason"]
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "execute@metal-1")
    answer = agent_tools.invoke_device("metal-1", "execute", {"instruction": "wave"})["result"]
    assert answer["status"] == "success"
    assert agent_tools.invoke_device("metal-1", "stop")["result"]["stopped"] is True


def test_agents_receive_events(connected: Lab) -> None:
    world = connected.worlds["arm-2"]
    steps = agent_tools.subscribe("device(arm-2).event(streamStep)")
    ends = agent_tools.subscribe("device(arm-2).event(policyComplete)")
    received: list[Any] = []

    def both_heard() -> bool:
        # A new subscription takes a moment to reach all devices.
        agent_tools.invoke_device("arm-2", "execute", {"instruction": "wave", "duration": 0.2})
        eventually(lambda: not world.rollouts["left"].running)
        received.extend(ends.read())
        return bool(received and steps.read())

    eventually(both_heard)
    assert "wave" in json.dumps(received)
    agent_tools.invoke_device("arm-2", "execute", {"instruction": "wave", "duration": 0.5})
    wave = world.rollouts["left"]
    eventually(lambda: not wave.running)
    numbers: list[int] = []

    def to_its_end() -> bool:
        numbers.extend(each["params"]["step"] for each in steps.read())
        return bool(numbers and numbers[-1] >= wave.steps - 1)

    eventually(to_its_end)
    # Late steps of the earlier tasks are left out.
    of_this_task = numbers[len(numbers) - 1 - numbers[::-1].index(1) :]
    assert len(of_this_task) >= wave.steps - 1


def test_broadcast_stops_the_fleet(connected: Lab) -> None:
    for name in connected.worlds:
        agent_tools.invoke_device(name, "execute", {"instruction": "wave"})
    conn = agent_tools.get_connection()
    conn.subscribe_buffered(f"device-connect.{conn.zone}.*.event.async_reply.>", name="replies")

    def heard_of_both() -> bool:
        # A new subscription takes a moment to reach all devices.
        agent_tools.broadcast("device(*).function(getFeatures)")
        return all(name in json.dumps(conn.get_inbox("replies")) for name in connected.worlds)

    eventually(heard_of_both)
    agent_tools.broadcast("device(*).function(stop)")
    eventually(lambda: not any(w.rollouts["left"].running for w in connected.worlds.values()))
    eventually(lambda: json.dumps(conn.get_inbox("replies")).count('"text": "Stopped left.') == 2)


def test_agents_see_the_present_availability(connected: Lab) -> None:
    def availability() -> Any:
        rows = agent_tools.discover_devices(refresh=True)
        return next((r["status"]["availability"] for r in rows if r["device_id"] == "arm-1"), None)

    agent_tools.invoke_device("arm-1", "execute", {"instruction": "wave"})
    eventually(lambda: availability() == "busy")
    agent_tools.invoke_device("arm-1", "stop")
    eventually(lambda: availability() == "idle")


def test_heartbeats_carry_the_state(connected: Lab) -> None:
    conn = agent_tools.get_connection()
    conn.subscribe_buffered(f"device-connect.{conn.zone}.arm-1.heartbeat", name="beats")
    agent_tools.invoke_device("arm-1", "execute", {"instruction": "wave"})
    eventually(lambda: '"instruction": "wave"' in json.dumps(conn.get_inbox("beats")))
    agent_tools.invoke_device("arm-1", "stop")


def test_real_agent_with_a_scripted_model_drives_and_stops_an_arm(connected: Lab) -> None:
    model = ScriptedModel(
        [
            ("discover", {"selector": "device(*)"}),
            ("invoke", {"selector": "device(arm-1).function(execute)", "params": {"instruction": "wave"}}),
            ("invoke", {"selector": "device(arm-1).function(stop)", "params": {}}),
            "The arm waved and stands still.",
        ]
    )
    agent = Agent(
        model=model,
        tools=[strands_tools.discover, strands_tools.invoke, strands_tools.broadcast],
        callback_handler=None,
    )
    answer = agent("Wave with the arm, then stop it.")
    assert "stands still" in str(answer)
    results = json.dumps(model.seen[-1])
    assert "Started 'wave' on left" in results
    assert "Stopped left" in results


def test_mcp_bridge_lists_calls_and_receives_events(lab: Lab) -> None:
    pytest.importorskip("fastmcp", reason="needs the extra bridge: make bridge", exc_type=ImportError)
    from fastmcp import Client  # noqa: PLC0415 - heavy
    from fastmcp.client.transports import StdioTransport  # noqa: PLC0415

    page = Path(__file__).parents[3].joinpath("docs", "agents.md").read_text("utf-8")
    blocks = [json.loads(each.partition("```")[0]) for each in page.split("```json\n")[1:]]
    block = next(each["mcpServers"]["device-connect"] for each in blocks if "device-connect" in each["mcpServers"])
    assert block["env"].keys() <= {"ZENOH_CONNECT", "DEVICE_CONNECT_DISCOVERY_MODE"}

    async def drive() -> None:
        # The block of docs/agents.md, on the lab's network.
        of_the_page = block["env"] if block["env"].keys() <= lab.environment.keys() else {}
        environment = {**os.environ, **of_the_page, **lab.environment}
        bridge = StdioTransport(sys.executable, block["args"], env=environment)
        async with Client(bridge) as client:
            assert {tool.name for tool in await client.list_tools()} >= {"describe_fleet", "invoke_device"}

            async def listed() -> bool:
                return "arm-1" in str((await client.call_tool("list_devices", {})).content)

            await eventually_async(listed, within=40)
            functions = await client.call_tool("get_device_functions", {"device_id": "arm-1"})
            assert "instruction" in str(functions.content)
            call = {
                "device_id": "arm-1",
                "function": "execute",
                "arguments": '{"instruction": "wave", "duration": 1.0}',
            }
            assert "success" in str((await client.call_tool("invoke_device", call)).content)
            an_object = {**call, "arguments": {"instruction": "wave"}}
            refused = await client.call_tool("invoke_device", an_object, raise_on_error=False)
            assert refused.is_error, "as the page says"
            end = {"device_id": "arm-1", "event_name": "policyComplete", "timeout_seconds": 30}
            assert "wave" in str((await client.call_tool("wait_for_event", end)).content)
            call["arguments"] = '{"instruction": "wave again"}'
            assert "success" in str((await client.call_tool("invoke_device", call)).content)
            stop = {"device_id": "arm-1", "function": "stop"}
            assert "Stopped left" in str((await client.call_tool("invoke_device", stop)).content)

    asyncio.run(drive())
    lab.still()
