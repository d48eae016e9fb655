"""An MCP client on stdio lists, moves and stops robots; a call that is given up halts what it began."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import pytest
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually, free_port

from strands_robots import Robot
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from mcp.client.client import Client
from mcp.client.stdio import StdioServerParameters, stdio_client

WAVE = {"robot": "arm-1", "instruction": "wave", "duration": 60.0}


class Site:
    """A toy world and a simulated arm on a loopback port of their own."""

    def __init__(self) -> None:
        self.port = free_port()
        self.world, self.arm = ToyWorld("one"), Robot("so100", peer_id="arm-2")
        bodies = {"arm-1": self.world, "arm-2": self.arm}
        link = loopback_config(self.port)
        self.runtimes = [init_device_connect_sync(body, peer_id=name, link=link) for name, body in bodies.items()]

    @property
    def moving(self) -> bool:
        rollout = self.world.rollouts.get("left")
        return rollout is not None and rollout.running

    async def until(self, moving: bool) -> None:
        await asyncio.to_thread(eventually, lambda: self.moving is moving)

    @asynccontextmanager
    async def client(self, *flags: str) -> AsyncIterator[Client]:
        command = ["-m", "strands_robots.cli", "mcp", "--port", str(self.port), *flags]
        server = StdioServerParameters(command=sys.executable, args=command, env=dict(os.environ))
        async with Client(stdio_client(server)) as client:
            yield client

    def close(self) -> None:
        for runtime in self.runtimes:
            stop_device_connect(runtime)
        self.world.close()


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.close()


async def test_a_client_lists_robots_by_a_small_set_of_tools_that_name_none(site: Site) -> None:
    async with site.client() as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert len(tools) <= 20
        assert tools["list_robots"].annotations.read_only_hint
        assert tools["move"].annotations.destructive_hint
        listed = await client.call_tool("list_robots", {})
        assert {each["id"] for each in listed.structured_content["data"]["robots"]} == {"arm-1", "arm-2"}
        assert "arm-1" not in str(tools)


async def test_a_simulated_arm_says_what_it_reached_and_refuses_what_it_cannot(site: Site) -> None:
    async with site.client() as client:
        answer = await client.call_tool("move", {"robot": "arm-2", "to": {"x": 0.25, "y": 0.0, "z": 0.1}})
        assert not answer.is_error, answer
        assert answer.structured_content["data"]["error_mm"] < 15
        for malformed in (
            {"to": {"x": 9.0, "y": 0.0, "z": 0.1}},
            {"to": {"x": True}},
            {},
            {"place": "a", "by": {"dx": 1}},
        ):
            assert (await client.call_tool("move", {"robot": "arm-2", **malformed})).is_error


async def test_a_cancelled_call_halts_the_motion_that_it_began(site: Site) -> None:
    async with site.client() as client:
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        call.cancel()
        await asyncio.wait([call])
        await site.until(False)


async def test_a_stop_is_answered_beside_a_long_call(site: Site) -> None:
    async with site.client() as client:
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        assert not (await client.call_tool("stop", {"robot": "arm-1"})).is_error
        assert not site.moving
        await call


async def test_a_lease_and_its_motion_end_with_the_client(site: Site) -> None:
    async with site.client("--as", "first") as client:
        refused = await client.call_tool("run_policy", {**WAVE, "wait": False})
        assert "acquire_control" in refused.structured_content["text"]
        held = await client.call_tool("acquire_control", {"robot": "arm-1", "robot_name": "left"})
        assert not held.is_error, held
        assert "lease_id" not in json.dumps(held.structured_content)
        begun = await client.call_tool("run_policy", {**WAVE, "wait": False})
        assert not begun.is_error, begun
        await site.until(True)
    await site.until(False)


async def test_client_holds_and_stops_the_robots_of_a_world_one_by_one(site: Site) -> None:
    async with site.client("--as", "first") as client, site.client("--as", "second") as other:
        for robot_name in ("left", "right"):
            held = await client.call_tool("acquire_control", {"robot": "arm-1", "robot_name": robot_name})
            assert held.structured_content["data"]["robot_name"] == robot_name, held
        for robot_name in ("left", "right"):
            wave = {**WAVE, "robot_name": robot_name, "wait": False}
            refused = await other.call_tool("run_policy", {**WAVE, "robot_name": robot_name})
            assert "holds control" in refused.structured_content["text"]
            assert not (await client.call_tool("run_policy", wave)).is_error
        await site.until(True)
        assert not (await client.call_tool("stop", {"robot": "arm-1", "robot_name": "left"})).is_error
        assert not site.moving
        assert [row["robot"] for row in site.world.list_policies_running()] == ["right"]


async def test_a_read_only_client_has_no_tool_that_moves_and_may_stop(site: Site) -> None:
    async with site.client("--read-only") as client:
        names = {tool.name for tool in (await client.list_tools()).tools}
        assert not names & {"move", "grasp", "run_policy", "acquire_control"}
        assert {"stop", "emergency_stop"} <= names
