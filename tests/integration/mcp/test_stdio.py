"""An MCP client on stdio lists, moves and stops robots; a call that is given up halts what it began."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from fixtures.mcp_site import WAVE, McpSite
from fixtures.waiting import eventually_async

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH

pytestmark = pytest.mark.parametrize("site", [DEVICE_CONNECT, MESH], indirect=True)
BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])


async def test_a_client_lists_robots_by_a_small_set_of_tools_that_name_none(site: McpSite) -> None:
    async with site.client() as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert len(tools) <= 20
        assert tools["list_robots"].annotations.read_only_hint
        assert tools["move"].annotations.destructive_hint
        listed = await client.call_tool("list_robots", {})
        assert {each["id"] for each in listed.structured_content["data"]["robots"]} == {"arm-1", "arm-2", "metal-1"}
        assert "arm-1" not in str(tools)


async def test_a_simulated_arm_says_what_it_reached_and_refuses_what_it_cannot(site: McpSite) -> None:
    async with site.client() as client:
        answers: list[Any] = []

        async def moved() -> bool:
            # A motion has its own few seconds; on a busy machine the next one goes on where it ended.
            answers.append(await client.call_tool("move", {"robot": "arm-2", "to": {"x": 0.25, "y": 0.0, "z": 0.1}}))
            return not answers[-1].is_error

        await eventually_async(moved, within=60, what=f"its arrival, and not {answers}")
        assert answers[-1].structured_content["data"]["error_mm"] < 15
        for malformed in (
            {"to": {"x": 9.0, "y": 0.0, "z": 0.1}},
            {"to": {"x": True}},
            {},
            {"place": "a", "by": {"dx": 1}},
        ):
            assert (await client.call_tool("move", {"robot": "arm-2", **malformed})).is_error


async def test_no_read_of_a_burst_is_refused_and_the_server_says_that_it_stands(site: McpSite) -> None:
    async with site.client() as client:
        burst = (client.call_tool("get_pose", {"robot": "arm-2"}) for _ in range(100))
        refused = [answer.content for answer in await asyncio.gather(*burst) if answer.is_error]
        assert refused == []

        async def stands() -> bool:
            answer = await client.call_tool("lockouts", {})
            return bool(answer.structured_content["data"]["stands"])

        await eventually_async(stands, within=60, what="its e-stop link")


@BOTH
async def test_a_cancelled_call_halts_the_motion_that_it_began(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        call.cancel()
        await asyncio.wait([call])
        await site.until(False)


@BOTH
async def test_a_stop_is_answered_beside_a_long_call(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        assert not (await client.call_tool("stop", {"robot": "arm-1"})).is_error
        assert not site.moving
        await call


async def test_a_lease_and_its_motion_end_with_the_client(site: McpSite) -> None:
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


async def test_client_holds_and_stops_the_robots_of_a_world_one_by_one(site: McpSite) -> None:
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


async def test_a_read_only_client_has_no_tool_that_moves_and_may_stop(site: McpSite) -> None:
    async with site.client("--read-only") as client:
        names = {tool.name for tool in (await client.list_tools()).tools}
        assert not names & {"move", "grasp", "run_policy", "acquire_control"}
        assert {"stop", "emergency_stop"} <= names
