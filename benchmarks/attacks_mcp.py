"""Attacks on the MCP server over HTTP: half-sent requests and sessions that nobody ends, with stops beside them."""

from __future__ import annotations

import asyncio
import os
import resource
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import httpx2
from fixtures.half_sent import KINDS, beginning, half_sent
from fixtures.mcp_frames import INITIALIZE, memory_mb
from fixtures.mcp_site import McpSite

from benchmarks.table import Row

HALF_SENT, SESSIONS = 1300, 3000
STOPS, STOPS_QUICK = 100, 5
DESCRIPTORS = 1024
STOP_MS, GROWTH_MB = 1000.0, 50.0
HEADERS = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}


def rows(quick: bool) -> list[Row]:
    """Measure and give the rows of the table."""
    with ExitStack() as stack:
        state = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-mcp-")))
        os.environ["STRANDS_STATE_DIR"] = str(state)
        stack.callback(os.environ.pop, "STRANDS_STATE_DIR")
        site = McpSite(state, simulated=False)
        stack.callback(site.close)
        token = site.token("desk")
        url = stack.enter_context(site.http())
        resource.prlimit(site.server.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
        stops = STOPS_QUICK if quick else STOPS
        return [*(_half_sent_row(site, url, token, kind, stops) for kind in KINDS), _sessions_row(site, url, token)]


def _half_sent_row(site: McpSite, url: str, token: str, kind: str, stops: int) -> Row:
    """Measure stops on new connections, each beside half-sent requests that have just come."""

    async def stop() -> bool:
        async with site.http_client(url, token, mode="2026-07-28") as client:
            return not (await client.call_tool("stop", {"robot": "arm-1"})).is_error

    def measured() -> float:
        began = time.monotonic()
        assert asyncio.run(stop()), "a stop was refused"
        return (time.monotonic() - began) * 1000

    bare = sorted(measured() for _ in range(stops))
    beside = []
    for _ in range(stops):
        with half_sent(url, HALF_SENT, beginning(kind, token)):
            beside.append(measured())
    beside.sort()
    quiet, worst = bare[len(bare) // 2], beside[-1]
    return Row(
        f"MCP over HTTP: {HALF_SENT:,} requests with {kind} sent, a stop of a new client beside them",
        f"p50 {beside[len(beside) // 2]:.0f} ms, worst {worst:.0f} ms",
        f"alone p50 {quiet:.0f} ms",
        beside[len(beside) // 2] / quiet,
        f"each answered within {STOP_MS:g} ms",
        worst <= STOP_MS,
    )


def _sessions_row(site: McpSite, url: str, token: str) -> Row:
    """Begin sessions that nobody ends; count those that are left."""
    ping = {"jsonrpc": "2.0", "id": 2, "method": "ping"}
    with httpx2.Client(headers={**HEADERS, "Authorization": f"Bearer {token}"}, timeout=30) as client:

        def begun(count: int) -> list[str]:
            return [client.post(url, json=INITIALIZE).headers["mcp-session-id"] for _ in range(count)]

        ids = begun(SESSIONS // 10)
        before = memory_mb(site.server.pid)
        ids += begun(SESSIONS - len(ids))
        growth = memory_mb(site.server.pid) - before
        left = sum(client.post(url, json=ping, headers={"Mcp-Session-Id": each}).is_success for each in ids)
    return Row(
        f"MCP over HTTP: {SESSIONS:,} sessions of one token that nobody ends",
        f"{left} are left, memory {growth:+.0f} MB",
        "",
        None,
        f"at most 32, memory + <= {GROWTH_MB:g} MB",
        left <= 32 and growth <= GROWTH_MB,
    )
