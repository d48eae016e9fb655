"""Half-sent requests and floods of sessions delay no stop over HTTP, and a refused request changes nothing."""

from __future__ import annotations

import asyncio
import resource
import ssl
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from pathlib import Path

import pytest
from fixtures.half_sent import KINDS, beginning, closed, half_sent
from fixtures.mcp_frames import INITIALIZE
from fixtures.mcp_site import WAVE, McpSite
from fixtures.memory import memory_mb
from fixtures.waiting import eventually

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

import httpx2

from strands_robots.certificates import CA_CERT
from strands_robots.mcp import connections, http
from strands_robots.mesh.transport.config import issue_certificate, make_authority
from strands_robots.serving.control_leases import leases_of

BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])
HALF_SENT, SESSIONS = 1300, 3000
STOP_S = 2.0
"""Longest time of a stop in a flood; a half-sent request lasts longer."""

DESCRIPTORS = 1024
HEADERS = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}


@pytest.fixture(scope="module")
def tokens(site: McpSite) -> dict[str, str]:
    return {name: site.token(name) for name in ("desk", "first")}


@pytest.fixture
def url(site: McpSite, tokens: dict[str, str]) -> Iterator[str]:
    with limited(site) as address:
        yield address


@pytest.fixture(scope="module")
def standing(site: McpSite, tokens: dict[str, str]) -> Iterator[str]:
    """The address of a server that outlives one flood after another."""
    with limited(site) as address:
        yield address


@contextmanager
def limited(site: McpSite) -> Iterator[str]:
    """Run a server with as many descriptors as a process may have by default."""
    with site.http() as address:
        resource.prlimit(site.server.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
        yield address


def bearer(token: str) -> dict[str, str]:
    return {**HEADERS, "Authorization": f"Bearer {token}"}


@BOTH
@pytest.mark.parametrize("kind", KINDS)
async def test_half_sent_requests_delay_no_stop(
    site: McpSite, standing: str, tokens: dict[str, str], mode: str, kind: str
) -> None:
    async with site.http_client(standing, tokens["desk"], mode=mode) as client:
        for _ in range(2):
            with half_sent(standing, HALF_SENT, beginning(kind, tokens["desk"])):
                began = time.monotonic()
                assert not (await client.call_tool("stop", {"robot": "arm-1"})).is_error
                async with site.http_client(standing, tokens["desk"], mode=mode) as another:
                    assert not (await another.call_tool("stop", {"robot": "arm-1"})).is_error
                assert time.monotonic() - began < STOP_S


def test_a_half_sent_request_is_closed_at_its_deadline(url: str, tokens: dict[str, str]) -> None:
    with ExitStack() as stack:
        held = [
            each for kind in KINDS for each in stack.enter_context(half_sent(url, 3, beginning(kind, tokens["desk"])))
        ]
        eventually(lambda: closed(held) == len(held), connections.BODY_S + 10)


async def test_the_connections_of_one_token_leave_a_reserve_for_its_stops(
    site: McpSite, url: str, tokens: dict[str, str]
) -> None:
    async with httpx2.AsyncClient(headers=bearer(tokens["desk"]), timeout=30) as client, AsyncExitStack() as streams:
        for _ in range(connections.TOKEN_MAX):
            # On a connection of its own, which is closed: an idle one gives way to new ones.
            begun = await asyncio.to_thread(httpx2.post, url, json=INITIALIZE, headers=bearer(tokens["desk"]))
            session = {"Mcp-Session-Id": begun.headers["mcp-session-id"]}
            stream = await streams.enter_async_context(client.stream("GET", url, headers=session))
            assert stream.status_code == 200
        await asyncio.to_thread(eventually, lambda: refused(url, tokens["desk"], session))
        assert not refused(url, tokens["first"], {}), "another token is refused"
        stop = {"name": "stop", "arguments": {"robot": "arm-1"}}
        for _ in range(3):
            call = {"jsonrpc": "2.0", "id": "stop", "method": "tools/call", "params": stop}
            answer = await asyncio.to_thread(httpx2.post, url, json=call, headers={**bearer(tokens["desk"]), **session})
            assert answer.status_code == 200
            assert "Nothing was moving" in answer.text


def refused(url: str, token: str, session: dict[str, str]) -> bool:
    """Return whether a call is refused because its token has too many connections."""
    call = {"jsonrpc": "2.0", "id": "x", "method": "tools/call", "params": {"name": "get_state", "arguments": {}}}
    return httpx2.post(url, json=call, headers={**bearer(token), **session}, timeout=30).status_code == 503


@pytest.mark.system
def test_sessions_that_nobody_uses_are_ended_for_new_ones(site: McpSite, url: str, tokens: dict[str, str]) -> None:
    ping = {"jsonrpc": "2.0", "id": 2, "method": "ping"}
    with httpx2.Client(headers=bearer(tokens["desk"]), timeout=30) as client:

        def begun() -> str:
            return str(client.post(url, json=INITIALIZE).headers["mcp-session-id"])

        used = begun()
        ids = []
        for number in range(SESSIONS):
            ids.append(begun())
            if number == 200:
                before = memory_mb(site.server.pid)
            if number % 10 == 0:
                assert client.post(url, json=ping, headers={"Mcp-Session-Id": used}).status_code == 200
        alive = [each for each in ids if client.post(url, json=ping, headers={"Mcp-Session-Id": each}).is_success]
        assert alive == ids[-len(alive) :]
        assert 0 < len(alive) <= connections.SESSIONS_OF_TOKEN_MAX
        assert memory_mb(site.server.pid) - before < 50


def test_a_request_that_begins_no_session_leaves_none(site: McpSite, url: str, tokens: dict[str, str]) -> None:
    with httpx2.Client(headers=bearer(tokens["desk"]), timeout=30) as client:
        refusals = [
            client.post(url, json={"jsonrpc": "2.0", "id": 1, "method": "tools/list"}),
            client.post(url, content=b"{", headers={"Content-Type": "application/json"}),
            client.get(url),
        ]
        for refusal in refusals:
            assert refusal.status_code in (400, 406)
            named = refusal.headers.get("mcp-session-id")
            ping = {"jsonrpc": "2.0", "id": 2, "method": "ping"}
            assert client.post(url, json=ping, headers={"Mcp-Session-Id": str(named)}).status_code == 404


@pytest.mark.parametrize(
    "wrong",
    [
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Authorization": "Bearer x"},
        {"Mcp-Session-Id": "x"},
    ],
    ids=["host", "origin", "token", "session"],
)
async def test_a_refused_delete_halts_nothing(
    site: McpSite, url: str, tokens: dict[str, str], wrong: dict[str, str]
) -> None:
    async with httpx2.AsyncClient(headers=bearer(tokens["desk"]), timeout=30) as client:
        begun = await client.post(url, json=INITIALIZE)
        session = {"Mcp-Session-Id": begun.headers["mcp-session-id"]}
        hold = {"name": "acquire_control", "arguments": {"robot": "arm-1", "robot_name": "left"}}
        call = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": hold}
        await client.post(url, json=call, headers=session)
        wave = {"name": "run_policy", "arguments": {**WAVE, "robot_name": "left", "wait": False}}
        await client.post(url, json={**call, "params": wave}, headers=session)
        assert holder(site) == "desk"
        refusal = await client.delete(url, headers={**session, **wrong})
        assert refusal.status_code >= 400
        await asyncio.sleep(http.LEFT_S + 1)  # a DELETE that counts halts after that
        assert holder(site) == "desk"
        assert site.moving
        assert (await client.delete(url, headers=session)).status_code == 200
        await asyncio.to_thread(eventually, lambda: holder(site) is None)
        assert not site.moving


def test_a_message_beyond_the_bound_is_refused_unparsed(url: str, tokens: dict[str, str]) -> None:
    long = b'{"jsonrpc":"2.0","id":1,"method":"initialize","params":[' + b"[]," * (http.MESSAGE_MAX // 3)
    for sent in (long, iter([long])):
        assert httpx2.post(url, content=sent, headers=bearer(tokens["desk"]), timeout=30).status_code == 413


def holder(site: McpSite) -> str | None:
    """Return who holds the first robot of the world."""
    return leases_of(site.world, hardware=False).of("left").facts().get("holder")


async def test_half_done_handshakes_of_tls_delay_no_stop(site: McpSite, tokens: dict[str, str], tmp_path: Path) -> None:
    make_authority(tmp_path)
    files = issue_certificate(tmp_path, "server", ["127.0.0.1"])
    with site.http("--http-cert", str(files.cert), "--http-key", str(files.key), scheme="https") as url:
        resource.prlimit(site.server.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
        trust = ssl.create_default_context(cafile=str(tmp_path / CA_CERT))
        async with site.http_client(url, tokens["desk"], verify=trust) as client:
            for begun in (b"", b"\x16\x03\x01\x02\x00"):
                with half_sent(url, HALF_SENT, begun):
                    began = time.monotonic()
                    assert not (await client.call_tool("stop", {"robot": "arm-1"})).is_error
                    async with site.http_client(url, tokens["desk"], verify=trust) as another:
                        assert not (await another.call_tool("stop", {"robot": "arm-1"})).is_error
                    assert time.monotonic() - began < STOP_S
