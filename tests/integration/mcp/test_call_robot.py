"""A client calls any verb of any robot: reads as reads, anything else as a motion."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from typing import Any

import pytest
from device_connect_edge.drivers import DeviceDriver, rpc
from fixtures.barista import Barista
from fixtures.mcp_site import WAVE, McpSite
from fixtures.waiting import eventually

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from mcp.types import ElicitResult

from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH

EACH = pytest.mark.parametrize("site", [DEVICE_CONNECT, MESH], indirect=True)
BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])
SHORT = {"instruction": "wave", "duration": 0.3, "policy_provider": "mock"}
REFUSED = {
    "stop": "use stop",
    "stopMotion": "use stop",
    "emergencyStop": "use emergency_stop",
    "acquireControl": "use acquire_control",
    "releaseControl": "use release_control",
    "renewControl": "the server renews",
    "takeControl": "only a human",
    "resume": "only a human operator",
}


class Kettle(DeviceDriver):  # type: ignore[misc]
    """A device of another maker, without a stop."""

    device_type = "kettle"

    @rpc(labels={"direction": "read"})
    async def temperature(self, unit: str = "C") -> dict[str, Any]:
        """Read the temperature."""
        return {"temperature": 20, "unit": unit}

    @rpc()
    async def boil(self, litres: float) -> dict[str, Any]:
        """Boil water."""
        return {"boiled": litres}


@pytest.fixture(scope="module")
def barista(site: McpSite) -> Iterator[Barista]:
    robot = Barista()
    leave = site.serve("barista-1", robot)
    yield robot
    leave()


@pytest.fixture(scope="module", autouse=True)
def kettle(site: McpSite) -> Iterator[None]:
    leave = site.serve("kettle-1", Kettle(), DEVICE_CONNECT)
    yield
    leave()


@pytest.fixture(autouse=True)
def still(site: McpSite) -> Iterator[None]:
    site.metal.answers.clear()
    yield
    site.still()


async def called(client: Any, robot: str, verb: str, **arguments: Any) -> Any:
    return await client.call_tool("call_robot", {"robot": robot, "verb": verb, "arguments": arguments})


async def test_device_of_another_maker_is_described_and_called(site: McpSite) -> None:
    async with site.client() as client:
        said = (await client.call_tool("describe_robot", {"robot": "kettle-1"})).structured_content["data"]
        assert said["note"] == "This device has no lockout, no lease and no stop."
        verbs = {each["name"]: each for each in said["verbs"]}
        assert {name: each["moves"] for name, each in verbs.items()} == {"temperature": False, "boil": True}
        assert verbs["boil"]["parameters"]["required"] == ["litres"]
        assert verbs["boil"]["parameters"]["properties"]["litres"]["type"] == "number"
        read = await called(client, "kettle-1", "temperature", unit="K")
        assert read.structured_content["data"] == {"temperature": 20, "unit": "K"}
        assert (await called(client, "kettle-1", "boil", litres=0.5)).structured_content["data"] == {"boiled": 0.5}
        unknown = await called(client, "kettle-1", "boll")
        assert "'kettle-1' has no verb 'boll'. Near it: boil." in unknown.structured_content["text"]
        wrong = await called(client, "kettle-1", "boil", liters=1.0)
        assert "takes no argument 'liters'; its arguments: litres." in wrong.structured_content["text"]


@EACH
async def test_verbs_of_our_robots_are_described_without_leases_and_within_a_bound(site: McpSite) -> None:
    async with site.client() as client:
        answer = await client.call_tool("describe_robot", {"robot": "arm-2"})
        assert len(answer.model_dump_json()) <= 64_000
        data = answer.structured_content["data"]
        verbs = {each["name"]: each for each in data["verbs"]}
        assert "x" in verbs["moveTo"]["parameters"]["properties"]
        assert "lease_id" not in json.dumps(data)
        assert not set(REFUSED) & set(verbs)
        assert "note" not in data


async def test_what_has_a_tool_of_its_own_is_refused_with_its_name(site: McpSite) -> None:
    async with site.client() as client:
        for verb, instead in REFUSED.items():
            answer = await called(client, "arm-1", verb)
            assert answer.is_error
            assert f"{verb}: {instead}" in answer.structured_content["text"]
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert tools["call_robot"].annotations.destructive_hint
        assert not tools["call_robot"].annotations.read_only_hint
    async with site.client("--read-only") as client:
        assert "call_robot" not in {tool.name for tool in (await client.list_tools()).tools}


@EACH
@BOTH
async def test_motion_that_is_called_is_halted_when_its_call_is_cancelled(site: McpSite, mode: str) -> None:
    wave = {**SHORT, "duration": WAVE["duration"]}
    async with site.client(mode=mode) as client:
        call = asyncio.ensure_future(called(client, "arm-1", "execute", **wave))
        await site.until(True)
        call.cancel()
        await asyncio.wait([call])
        await site.until(False)


async def test_robot_that_another_client_holds_refuses_a_called_motion(site: McpSite) -> None:
    async with site.client("--as", "first") as client, site.client("--as", "second") as other:
        assert not (await client.call_tool("acquire_control", {"robot": "arm-1"})).is_error
        for verb, arguments in (("execute", SHORT), ("reset", {})):
            refused = await called(other, "arm-1", verb, **arguments)
            assert "holds control" in refused.structured_content["text"]
        assert not (await called(client, "arm-1", "step", n_steps=1)).is_error


@EACH
@BOTH
async def test_real_hardware_is_moved_after_the_users_yes_alone(site: McpSite, mode: str) -> None:
    asked: list[str] = []
    answers = ["decline", "accept", "decline"]

    async def user(context: object, params: Any) -> ElicitResult:
        asked.append(params.message)
        return ElicitResult(action=answers[len(asked) - 1], content={"approve": True})

    async with site.client(mode=mode, elicitation_callback=user) as client:
        assert (await called(client, "metal-1", "execute", **SHORT)).is_error
        assert site.metal.answers == []
        assert not (await called(client, "metal-1", "execute", **SHORT)).is_error
        assert len(site.metal.answers) == 1
        assert (await called(client, "metal-1", "releaseTorque", motor_ids="pan")).is_error
    assert 'What: releaseTorque {"motor_ids": "pan"}' in asked[2]
    assert "How far: not known before; it is a verb of the robot's own" in asked[2]


@EACH
async def test_own_verb_is_stopped_when_its_call_is_given_up(site: McpSite, barista: Barista) -> None:
    async with site.client(elicitation_callback=_approving) as client:
        brewing = asyncio.ensure_future(called(client, "barista-1", "brewCoffee", cups=8))
        await asyncio.to_thread(eventually, barista.brewing.is_set)
        brewing.cancel()
        await asyncio.wait([brewing])
        await asyncio.to_thread(eventually, lambda: not barista.brewing.is_set())


async def _approving(context: object, params: Any) -> ElicitResult:
    return ElicitResult(action="accept", content={"approve": True})
