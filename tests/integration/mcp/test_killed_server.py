"""A server that is killed leaves no robot moving: the robot halts by itself when the server is silent."""

from __future__ import annotations

import asyncio

import pytest
from fixtures.mcp_frames import RawServer
from fixtures.mcp_site import WAVE, McpSite

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from strands_robots.mcp.caller import SILENCE_S
from strands_robots.serving.control_leases import leases_of

HELD = {"robot": "arm-1", "robot_name": "left", "ttl_s": 600.0}


def held(site: McpSite) -> object:
    """Return whether anyone holds the first robot of the world."""
    return leases_of(site.world, hardware=False).of("left").facts()["held"]


async def test_a_motion_outlasts_the_time_after_which_a_silent_server_is_lost(site: McpSite) -> None:
    async with site.client() as client:
        lasting = {**WAVE, "duration": 2 * SILENCE_S}
        call = asyncio.ensure_future(client.call_tool("run_policy", lasting))
        await site.until(True)
        rollout = site.world.rollouts["left"]
        assert not (await call).is_error
        assert rollout.state == "completed", "the motion was halted beside a live server"


async def test_a_killed_server_on_stdio_leaves_no_robot_moving(site: McpSite) -> None:
    with RawServer(site) as server:
        server.send(server.call(1, "run_policy", {**WAVE, "duration": 3600.0}))
        await site.until(True)
        server.process.kill()
        await site.until(False)
    assert site.world.rollouts["left"].state == "stopped"


async def test_a_killed_server_over_http_leaves_no_robot_moving(site: McpSite) -> None:
    with site.http() as url:
        with site.child(url, "", "auto", "run_policy", {**WAVE, "duration": 3600.0}):
            await site.until(True)
            site.server.kill()
            await site.until(False)
    assert site.world.rollouts["left"].state == "stopped"


async def test_a_killed_server_loses_what_its_client_held_for_long(site: McpSite) -> None:
    with RawServer(site) as server:
        answer = server.ask(server.call(1, "acquire_control", HELD))["result"]["structuredContent"]
        assert answer["data"]["expires_in_s"] == HELD["ttl_s"], answer
        begun = server.ask(server.call(2, "run_policy", {**WAVE, "duration": 3600.0, "wait": False}))
        assert not begun["result"].get("isError"), begun
        await site.until(True)
        server.process.kill()
        await site.until(False)
    assert held(site) is False
