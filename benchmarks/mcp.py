"""Stops, cancellations and lost clients of the MCP server, to the last write; and the lists of many robots."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx2
from fixtures.mcp_site import WAVE, McpSite
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually
from mcp import MCPError
from mcp.client.client import Client

from benchmarks.table import Row
from strands_robots.device_connect import FleetClient, init_device_connect_sync, loopback_config
from strands_robots.device_connect.discovery import Peer
from strands_robots.mcp.access import ClientAccess
from strands_robots.mcp.approval import Approvals
from strands_robots.mcp.caller import Caller
from strands_robots.mcp.resources import RobotResources
from strands_robots.mcp.server import build

HZ = 200.0
TIMES, TIMES_QUICK = 100, 5
STOP_MS, HALT_MS, PAGE_BYTES = 80.0, 300.0, 8000
ROBOTS = 500
AFTER_S = 0.4
"""Seconds for which writes are waited for after the last one may have come."""

OTHERS = ("arm-3", "arm-4")
LONG = {**WAVE, "duration": 3600.0}
TIMEOUT_S = 1.5
MODE = "2026-07-28"
STDIO_CHILD = """
import asyncio, json, sys
from mcp.client.client import Client
from mcp.client.stdio import StdioServerParameters, stdio_client
async def main(wave, *command):
    server = StdioServerParameters(command=sys.executable, args=list(command), env=dict(__import__("os").environ))
    async with Client(stdio_client(server)) as client:
        await client.call_tool("run_policy", json.loads(wave))
asyncio.run(main(*sys.argv[1:]))
"""


class Site(McpSite):
    """Three worlds of robots that move numbers."""

    def __init__(self, state: Path) -> None:
        super().__init__(state, simulated=False)
        # Often enough that a halt does not hide between two writes.
        self.world.hz = HZ
        link = loopback_config(self.port)
        self.fleet = FleetClient(link, "bench")
        self.fleet.__enter__()
        for name in OTHERS:
            self.runtimes.append(init_device_connect_sync(ToyWorld(name), peer_id=name, link=link))

    async def last_write_ms(self, give_up: Callable[[], Awaitable[object]]) -> float:
        """Return the milliseconds from the end of a moving call to the last write."""
        await self.until(True)
        steps = len(self.world.writes)
        await asyncio.to_thread(eventually, lambda: len(self.world.writes) > steps + 3)
        began = time.monotonic()
        await give_up()
        await self.until(False)
        await asyncio.sleep(AFTER_S)
        self.world.halt()
        return max(0.0, self.world.writes[-1] - began) * 1000


def run(*, quick: bool = False) -> list[Row]:
    """Measure and return the rows of this part."""
    times = TIMES_QUICK if quick else TIMES
    with tempfile.TemporaryDirectory(prefix="bench-mcp-") as folder:
        state = Path(folder)
        state.chmod(0o700)
        before = os.environ.get("STRANDS_STATE_DIR")
        os.environ["STRANDS_STATE_DIR"] = folder
        site = Site(state)
        try:
            return [*asyncio.run(measured(site, times)), asyncio.run(pages())]
        finally:
            site.fleet.close()
            site.close()
            if before is None:
                del os.environ["STRANDS_STATE_DIR"]
            else:
                os.environ["STRANDS_STATE_DIR"] = before


async def measured(site: Site, times: int) -> list[Row]:
    rows = []
    with site.http() as url:
        clients = {"stdio": lambda: site.client(mode=MODE), "HTTP": lambda: site.http_client(url, mode=MODE)}
        for name, connect in clients.items():
            async with connect() as client:
                rows.append(await stops(site, client, name, times))
                rows.append(halted(f"Cancelled call, {name}", [await cancelled(site, client) for _ in range(times)]))
                late = [await timed_out(site, client) for _ in range(times)]
                rows.append(halted(f"Call that timed out, {name}", late))
        rows.append(halted("Closed stream, HTTP", [await closed(site, url) for _ in range(times)]))
        killed = [await killed_http(site, url) for _ in range(times)]
        rows.append(halted("Client killed with SIGKILL, HTTP", killed))
    rows.append(halted("Client killed with SIGKILL, stdio", [await killed_stdio(site) for _ in range(times)]))
    return rows


def halted(what: str, took: list[float]) -> Row:
    kept = sum(each <= HALT_MS for each in took)
    took.sort()
    ours = f"{took[len(took) // 2]:.0f} ms, at most {took[-1]:.0f} ms to the last write"
    return Row(what, ours, f"{kept} of {len(took)}", None, f"<= {HALT_MS:.0f} ms, all", kept == len(took))


async def stops(site: Site, client: Any, name: str, times: int) -> Row:
    """Stop one of three robots whose tools run; look for writes after the answer."""
    took, after = [], 0
    others = [asyncio.ensure_future(client.call_tool("run_policy", {**LONG, "robot": each})) for each in OTHERS]
    direct: list[float] = []
    for _ in range(times):
        direct.append(await stopped_directly(site, client))
        call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
        await site.until(True)
        began = time.monotonic()
        answer = await client.call_tool("stop", {"robot": "arm-1"})
        answered = time.monotonic()
        assert not answer.is_error, answer
        took.append((answered - began) * 1000)
        await call
        await asyncio.sleep(0.1)
        after += sum(write > answered for write in site.world.writes)
    for other in others:
        other.cancel()
    await asyncio.wait(others)
    ours, bare = p99(took), p99(direct)
    text = f"p50 {sorted(took)[len(took) // 2]:.0f} ms, p99 {ours:.0f} ms, {after} writes after the answer"
    must = f"p99 <= {STOP_MS:.0f} ms, no write after"
    against = f"p99 {bare:.0f} ms without the server"
    return Row(f"`stop` while three tools run, {name}", text, against, ours / bare, must, ours <= STOP_MS and not after)


async def stopped_directly(site: Site, client: Any) -> float:
    call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))
    await site.until(True)
    began = time.monotonic()
    await site.fleet.stop_async("arm-1")
    took = (time.monotonic() - began) * 1000
    await call
    return took


def p99(took: list[float]) -> float:
    return sorted(took)[min(len(took) - 1, int(len(took) * 0.99))]


async def cancelled(site: Site, client: Any) -> float:
    call = asyncio.ensure_future(client.call_tool("run_policy", WAVE))

    async def give_up() -> None:
        call.cancel()
        await asyncio.wait([call])

    return await site.last_write_ms(give_up)


async def timed_out(site: Site, client: Any) -> float:
    began = time.monotonic()
    call = asyncio.ensure_future(client.call_tool("run_policy", WAVE, read_timeout_seconds=TIMEOUT_S))
    await site.until(True)
    with contextlib.suppress(MCPError, TimeoutError):
        await call
    await site.until(False)
    return max(0.0, site.world.writes[-1] - began - TIMEOUT_S) * 1000


async def closed(site: Site, url: str) -> float:
    call = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": INITIALIZE}
    headers = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}
    async with httpx2.AsyncClient(headers=headers, timeout=30) as http:
        begun = await http.post(url, json=call)
        http.headers["mcp-session-id"] = begun.headers["mcp-session-id"]
        await http.post(url, json={"jsonrpc": "2.0", "method": "notifications/initialized"})
        call = {"jsonrpc": "2.0", "id": 2, "method": "tools/call", "params": {"name": "run_policy", "arguments": WAVE}}
        stream = http.stream("POST", url, json=call)
        await stream.__aenter__()
        return await site.last_write_ms(lambda: stream.__aexit__(None, None, None))


INITIALIZE = {"protocolVersion": "2025-11-25", "capabilities": {}, "clientInfo": {"name": "bench", "version": "1"}}


async def killed_http(site: Site, url: str) -> float:
    with site.child(url, "", MODE, "run_policy", WAVE) as child:
        return await site.last_write_ms(lambda: asyncio.to_thread(child.kill))


async def killed_stdio(site: Site) -> float:
    command = [sys.executable, "-c", STDIO_CHILD, json.dumps(WAVE), *site.command()]
    with _started(command, site) as child:
        return await site.last_write_ms(lambda: asyncio.to_thread(child.kill))


def _started(command: list[str], site: Site) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, env=site.environment)


async def pages() -> Row:
    """Measure every page of a list of robots whose fields are as long as they may be."""
    name, model = "r" * 120, 'a "model" ' * 6
    status = {"availability": "available"}
    peers = [Peer(f"{name}{number:03}", "strands_robot" * 3, model, status) for number in range(ROBOTS)]
    fleet: Any = SimpleNamespace(peers=lambda: peers, source="bench", known=lambda: ())
    access = ClientAccess(Caller(fleet), approves=False, show_picture=lambda jpeg: "")
    server = build(lambda context: access, RobotResources(fleet), Approvals())
    sizes, seen, start = [], 0, 0
    async with Client(server) as client:
        while True:
            answer = await client.call_tool("list_robots", {"start": start})
            sizes.append(len(answer.model_dump_json(by_alias=True, exclude_none=True)))
            data = answer.structured_content["data"]
            seen += len(data["robots"])
            if "next_start" not in data:
                break
            start = data["next_start"]
    ours = f"{len(sizes)} pages, at most {max(sizes)} bytes, {seen} robots"
    ok = max(sizes) <= PAGE_BYTES and seen == ROBOTS
    return Row(f"`list_robots` of {ROBOTS} robots with the longest names", ours, "", None, "<= 8 kB a page", ok)
