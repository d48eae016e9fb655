"""Over HTTP a token names the caller; who asks from elsewhere, or goes away, is refused, or halts."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator

import pytest
from fixtures.mcp_site import WAVE, McpSite
from fixtures.waiting import eventually, free_port

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

import httpx2
from mcp import MCPError

from strands_robots.serving.control_leases import leases_of

BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])

PING = {"jsonrpc": "2.0", "id": 1, "method": "tools/list", "params": {}}
HEADERS = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}


@pytest.fixture(scope="module")
def tokens(site: McpSite) -> dict[str, str]:
    made = {"desk": site.token("desk"), "reader": site.token("reader", "--read-only"), "gone": site.token("gone")}
    return {**made, "yes": site.token("second", "--approves")}


@pytest.fixture(scope="module")
def url(site: McpSite, tokens: dict[str, str]) -> Iterator[str]:
    with site.http() as address:
        yield address


def post(url: str, token: str = "", **headers: str) -> int:
    bearer = {"Authorization": f"Bearer {token}"} if token else {}
    return httpx2.post(url, json=PING, headers={**HEADERS, **bearer, **headers}).status_code


def test_a_request_without_a_good_token_is_refused(url: str, tokens: dict[str, str]) -> None:
    assert post(url) == 401
    assert post(url, "nonsense") == 401
    assert post(url, tokens["desk"] + "x") == 401
    assert post(url, tokens["desk"]) != 401


def test_a_foreign_host_or_origin_is_refused(url: str, tokens: dict[str, str]) -> None:
    assert post(url, tokens["desk"], Host="evil.example") in (403, 421)
    assert post(url, tokens["desk"], Origin="http://evil.example") == 403
    assert post(url, tokens["desk"], Origin=url.removesuffix("/mcp")) not in (401, 403, 421)


def test_a_revoked_token_is_refused_at_once(site: McpSite, url: str) -> None:
    token = site.token("passing")
    assert post(url, token) != 401
    site.token("passing", "--revoke")
    assert post(url, token) == 401


def test_another_address_needs_tls_and_a_token(site: McpSite, tmp_path: object) -> None:
    command = [sys.executable, *site.command("--http", f"0.0.0.0:{free_port()}")]
    refused = subprocess.run(command, env=site.environment, capture_output=True, text=True, timeout=100, check=False)
    assert refused.returncode != 0
    assert "TLS" in refused.stderr + refused.stdout


@BOTH
async def test_a_robot_is_a_resource_over_http_too(site: McpSite, url: str, tokens: dict[str, str], mode: str) -> None:
    async with site.http_client(url, tokens["desk"], mode=mode) as client:
        read = await client.read_resource("robot://arm-1")
        assert "running_policies" in read.contents[0].text


@BOTH
async def test_the_name_of_the_token_is_the_callers(site: McpSite, url: str, tokens: dict[str, str], mode: str) -> None:
    async with site.http_client(url, tokens["desk"], mode=mode) as client:
        held = await client.call_tool("acquire_control", {"robot": "arm-1"})
        assert not held.is_error, held
        state = (await client.call_tool("get_state", {"robot": "arm-1"})).structured_content["data"]
        assert state["control"]["left"]["holder"] == "desk"
        assert not (await client.call_tool("release_control", {"robot": "arm-1"})).is_error


@BOTH
async def test_a_read_only_token_moves_nothing_and_may_stop(
    site: McpSite, url: str, tokens: dict[str, str], mode: str
) -> None:
    async with site.http_client(url, tokens["reader"], mode=mode) as client:
        names = {tool.name for tool in (await client.list_tools()).tools}
        assert not names & {"move", "grasp", "run_policy", "acquire_control"}
        assert (await client.call_tool("run_policy", WAVE)).is_error
        assert not (await client.call_tool("stop", {"robot": "arm-1"})).is_error


@BOTH
async def test_a_cancelled_call_halts_the_motion_that_it_began(
    site: McpSite, url: str, tokens: dict[str, str], mode: str
) -> None:
    async with site.http_client(url, tokens["desk"], mode=mode) as client:
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        call.cancel()
        await asyncio.wait([call])
        await site.until(False)


@BOTH
async def test_a_call_that_times_out_halts_the_motion_that_it_began(
    site: McpSite, url: str, tokens: dict[str, str], mode: str
) -> None:
    async with site.http_client(url, tokens["desk"], mode=mode) as client:
        with pytest.raises((MCPError, TimeoutError)):
            await client.call_tool("run_policy", WAVE, read_timeout_seconds=0.8)
        await site.until(False)


@BOTH
async def test_a_closed_stream_and_a_killed_client_halt_the_motion(
    site: McpSite, url: str, tokens: dict[str, str], mode: str
) -> None:
    with site.child(url, tokens["desk"], mode, "run_policy", WAVE) as child:
        await site.until(True)
        child.kill()
        await site.until(False)


async def test_a_client_with_a_standing_stream_loses_its_lease_when_it_is_killed(
    site: McpSite, url: str, tokens: dict[str, str]
) -> None:
    with site.child(
        url, tokens["gone"], "legacy", "acquire_control", {"robot": "arm-1", "robot_name": "left", "ttl_s": 600}
    ) as child:
        await asyncio.to_thread(eventually, lambda: holder(site) == "gone")
        child.kill()
        # Released: it would last ten minutes more.
        await asyncio.to_thread(eventually, lambda: holder(site) is None)


@BOTH
async def test_a_stop_is_answered_beside_a_long_call(
    site: McpSite, url: str, tokens: dict[str, str], mode: str
) -> None:
    async with site.http_client(url, tokens["desk"], mode=mode) as client:
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        assert not (await client.call_tool("stop", {"robot": "arm-1"})).is_error
        assert not site.moving
        await call


async def test_the_server_halts_what_it_moves_when_it_is_told_to_end(site: McpSite, tokens: dict[str, str]) -> None:
    with site.http() as address, site.child(address, tokens["desk"], "auto", "run_policy", WAVE):
        await site.until(True)
        site.server.terminate()
        await site.until(False)


def holder(site: McpSite) -> str | None:
    """Return who holds the first robot of the world."""
    facts = leases_of(site.world, hardware=False).of("left").facts()
    return facts.get("holder")
