"""Robots are resources that tell of their updates; progress says what a robot does."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fixtures.mcp_site import WAVE, McpSite

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.mcp.results import MARK
from strands_robots.mcp.server import INSTRUCTIONS

EACH = pytest.mark.parametrize("site", [DEVICE_CONNECT, MESH], indirect=True)
BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])
ARM = "robot://arm-1"
SHORT = {**WAVE, "duration": 2.0}


@EACH
@BOTH
async def test_robots_are_resources_whose_state_is_quoted(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        listed = await client.list_resources()
        assert {str(each.uri) for each in listed.resources} >= {ARM, "robot://arm-2", "robot://metal-1"}
        read = await client.read_resource(ARM)
        assert read.contents[0].text.startswith(MARK)
        assert "running_policies" in read.contents[0].text


@EACH
async def test_a_stream_of_the_newest_revision_tells_of_updates(site: McpSite) -> None:
    async with site.client(mode="2026-07-28") as client:
        async with client.listen(resource_subscriptions=[ARM]) as events:
            assert not (await client.call_tool("run_policy", SHORT)).is_error
            event = await asyncio.wait_for(anext(aiter(events)), 10)
            assert event.uri == ARM


@EACH
async def test_a_subscription_of_an_older_revision_tells_of_updates(site: McpSite) -> None:
    told = asyncio.Event()

    async def received(message: Any) -> None:
        if getattr(message, "method", "") == "notifications/resources/updated":
            told.set()

    async with site.client(mode="legacy", message_handler=received) as client:
        await client.session.subscribe_resource(ARM)
        assert not (await client.call_tool("run_policy", SHORT)).is_error
        await asyncio.wait_for(told.wait(), 10)
        await client.session.unsubscribe_resource(ARM)


@EACH
@BOTH
async def test_progress_says_what_the_robot_does(site: McpSite, mode: str) -> None:
    said: list[str] = []

    async def progress(done: float, total: float | None, message: str | None) -> None:
        said.append(message or "")

    async with site.client(mode=mode) as client:
        assert not (await client.call_tool("run_policy", SHORT, progress_callback=progress)).is_error
    assert any(text.startswith(MARK) and "wave" in text for text in said), said


@pytest.mark.parametrize("mode", ["legacy", "auto"])
async def test_the_guide_is_the_servers_instructions_and_a_prompt(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        assert client.instructions == INSTRUCTIONS
        assert [each.name for each in (await client.list_prompts()).prompts] == ["operate_robots"]
        prompt = await client.get_prompt("operate_robots")
        assert prompt.messages[0].content.text == INSTRUCTIONS
    for rule in ("Look before you move", "error_mm", "only a human operator resumes", "Never answer a stop by moving"):
        assert rule in INSTRUCTIONS
