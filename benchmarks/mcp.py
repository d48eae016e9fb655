"""Stops, cancellations and lost clients of the MCP server, to the last write; and the lists of many robots."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx2
from fixtures.mcp_frames import INITIALIZE, RawServer
from fixtures.mcp_site import WAVE, McpSite
from fixtures.toy_robots import ToyWorld
from mcp import MCPError
from mcp.client.client import Client

from benchmarks.table import Row
from strands_robots.device_connect import FleetClient, loopback_config
from strands_robots.fleet.adapter import FoundRobot
from strands_robots.fleet.safety_console import StandingController
from strands_robots.mcp.approval import Approvals
from strands_robots.mcp.caller import SILENCE_S, Caller, ClientAccess
from strands_robots.mcp.server import RobotResources, build

HZ = 200.0
TIMES, TIMES_QUICK = 100, 5
SERVERS, SERVERS_QUICK = 20, 2
STOP_MS, HALT_MS, PAGE_BYTES = 80.0, 300.0, 8000
ROBOTS = 500
BURST, BURSTS = 100, 7
AFTER_S = 0.4
"""Seconds for which writes are waited for after the last one may have come."""

PATIENCE_S = 60.0
MOVERS = ("arm-1", "arm-5", "arm-6", "arm-7")
"""Robots that are given up, side by side."""

OTHERS = ("arm-3", "arm-4")
"""Robots that move while another is stopped."""

LONG = {**WAVE, "duration": 3600.0}
TIMEOUT_S = 1.0
MODE = "2026-07-28"
CLIENTS = """
import asyncio, json, os, signal, sys
import httpx2
from mcp.client.client import Client
from mcp.client.stdio import StdioServerParameters, stdio_client
from mcp.client.streamable_http import streamable_http_client

async def call(transport, mode, arguments):
    async with Client(transport, mode=mode) as client:
        await client.call_tool("run_policy", arguments)

async def run(order):
    mode, arguments = order["mode"], order["arguments"]
    if "url" in order:
        async with httpx2.AsyncClient(timeout=60) as http:
            await call(streamable_http_client(order["url"], http_client=http), mode, arguments)
    server = StdioServerParameters(command=sys.executable, args=order["command"], env=dict(os.environ))
    await call(stdio_client(server), mode, arguments)

signal.signal(signal.SIGCHLD, signal.SIG_IGN)
for line in sys.stdin:
    process = os.fork()
    if process == 0:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        asyncio.run(run(json.loads(line)))
        os._exit(0)
    print(process, flush=True)
"""
"""Starts a client in a process of its own for each line that it reads; each moves a robot until it is killed."""


@dataclass(frozen=True)
class Mover:
    """A robot whose motion is given up again and again."""

    name: str
    world: ToyWorld

    @property
    def wave(self) -> dict[str, Any]:
        return {**WAVE, "robot": self.name}

    @property
    def moving(self) -> bool:
        rollout = self.world.rollouts.get("left")
        return rollout is not None and rollout.running

    async def until(self, moving: bool) -> None:
        """Wait until the robot moves, or stands."""
        await self.wait_for(lambda: self.moving is moving)

    async def wait_for(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition of the robot."""
        give_up = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > give_up:
                raise TimeoutError(f"{self.name} did not do it in {PATIENCE_S:g} s")
            await asyncio.sleep(0.002)

    async def last_write_ms(self, give_up: Callable[[], Awaitable[object]]) -> float:
        """Return the milliseconds from the end of a moving call to the last write."""
        await self.until(True)
        steps = len(self.world.writes)
        await self.wait_for(lambda: len(self.world.writes) > steps + 3)
        began = time.monotonic()
        await give_up()
        return await self.last_write_after(began)

    async def last_write_after(self, began: float) -> float:
        await self.until(False)
        await asyncio.sleep(AFTER_S)
        self.world.halt()
        return max(0.0, self.world.writes[-1] - began) * 1000


class Site(McpSite):
    """Worlds of robots that move numbers."""

    def __init__(self, state: Path) -> None:
        super().__init__(state, simulated=False)
        self.fleet = FleetClient(loopback_config(self.port), "bench")
        self.fleet.__enter__()
        worlds = {MOVERS[0]: self.world, **{name: ToyWorld(name) for name in (*MOVERS[1:], *OTHERS)}}
        for name, world in worlds.items():
            if world is not self.world:
                self.serve(name, world)
        self.movers = [Mover(name, worlds[name]) for name in MOVERS]
        for mover in self.movers:
            # Often enough that a halt does not hide between two writes.
            mover.world.hz = HZ

    async def each(self, times: int, trial: Callable[[Mover], Awaitable[float]]) -> list[float]:
        """Carry a trial out so many times, on all movers at once."""
        left = iter(range(times))

        async def work(mover: Mover) -> list[float]:
            return [await trial(mover) for _ in left]

        return [took for each in await asyncio.gather(*map(work, self.movers)) for took in each]

    @contextlib.contextmanager
    def clients(self) -> Iterator[Callable[..., Awaitable[int]]]:
        """Yield what starts a client and returns its process, which has its libraries loaded."""
        command = [sys.executable, "-c", CLIENTS]
        with subprocess.Popen(
            command, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as starter:
            assert starter.stdin is not None
            assert starter.stdout is not None
            orders, processes = starter.stdin, starter.stdout
            turn = asyncio.Lock()

            async def start(**order: Any) -> int:
                async with turn:
                    orders.write(json.dumps({"mode": MODE, **order}) + "\n")
                    orders.flush()
                    return int(await asyncio.to_thread(processes.readline))

            try:
                yield start
            finally:
                starter.kill()


def run(*, quick: bool = False) -> list[Row]:
    """Measure and return the rows of this part."""
    with tempfile.TemporaryDirectory(prefix="bench-mcp-") as folder:
        state = Path(folder)
        state.chmod(0o700)
        before = os.environ.get("STRANDS_STATE_DIR")
        os.environ["STRANDS_STATE_DIR"] = folder
        site = Site(state)
        try:
            rows = [*asyncio.run(measured(site, quick=quick)), asyncio.run(pages())]
        finally:
            site.fleet.close()
            site.close()
            if before is None:
                del os.environ["STRANDS_STATE_DIR"]
            else:
                os.environ["STRANDS_STATE_DIR"] = before
    return [*rows, *bursts(quick=quick)]


def bursts(*, quick: bool) -> list[Row]:
    """Read the pose of a simulated arm many times at once; count refusals."""
    times = 1 if quick else BURSTS
    with tempfile.TemporaryDirectory(prefix="bench-mcp-") as folder:
        state = Path(folder)
        state.chmod(0o700)
        site = McpSite(state)

        async def read(name: str, connection: Any) -> Row:
            refused, took = [], []
            async with connection as client:
                for _ in range(times):
                    began = time.monotonic()
                    calls = (client.call_tool("get_pose", {"robot": "arm-2"}) for _ in range(BURST))
                    refused.append(sum(each.is_error for each in await asyncio.gather(*calls)))
                    took.append((time.monotonic() - began) * 1000)
            ours = f"{sum(refused)} refused, {sorted(took)[len(took) // 2]:.0f} ms a burst"
            kept = f"{refused.count(0)} of {times}"
            return Row(f"{BURST} `get_pose` at once, {name}", ours, kept, None, "none refused", not any(refused))

        async def both() -> list[Row]:
            with site.http() as url:
                return [await read("stdio", site.client()), await read("HTTP", site.http_client(url))]

        try:
            return asyncio.run(both())
        finally:
            site.close()


async def measured(site: Site, *, quick: bool) -> list[Row]:
    times, rows = TIMES_QUICK if quick else TIMES, []
    with site.http() as url, site.clients() as start:
        clients = {"stdio": lambda: site.client(mode=MODE), "HTTP": lambda: site.http_client(url, mode=MODE)}
        for name, connect in clients.items():
            async with connect() as client:
                rows.append(await stops(site, client, name, times))
                given_up = await site.each(times, lambda mover, client=client: cancelled(mover, client))
                rows.append(halted(f"Cancelled call, {name}", given_up))
                late = await site.each(times, lambda mover, client=client: timed_out(mover, client))
                rows.append(halted(f"Call that timed out, {name}", late))
        rows.append(halted("Closed stream, HTTP", await site.each(times, lambda mover: closed(mover, url))))
        ways: dict[str, dict[str, Any]] = {"HTTP": {"url": url}, "stdio": {"command": site.command()}}
        for name, way in ways.items():
            ends = await site.each(times, lambda mover, way=way: killed(mover, start, way))
            rows.append(halted(f"Client killed with SIGKILL, {name}", ends))
    servers = await site.each(SERVERS_QUICK if quick else SERVERS, lambda mover: killed_server(mover, site))
    rows.append(halted("Server killed with SIGKILL, stdio", servers, SILENCE_S * 1000 + HALT_MS))
    return rows


def halted(what: str, took: list[float], bound_ms: float = HALT_MS) -> Row:
    kept = sum(each <= bound_ms for each in took)
    took.sort()
    ours = f"{took[len(took) // 2]:.0f} ms, at most {took[-1]:.0f} ms to the last write"
    return Row(what, ours, f"{kept} of {len(took)}", None, f"<= {bound_ms:.0f} ms, all", kept == len(took))


async def stops(site: Site, client: Any, name: str, times: int) -> Row:
    """Stop one of three robots whose tools run; look for writes after the answer."""
    others = [asyncio.ensure_future(client.call_tool("run_policy", {**LONG, "robot": each})) for each in OTHERS]

    async def direct(robot: str) -> None:
        await site.fleet.stop_async(robot)

    async def by_server(robot: str) -> None:
        answer = await client.call_tool("stop", {"robot": robot})
        assert not answer.is_error, answer

    ways = {direct: list[float](), by_server: list[float]()}
    after = 0
    for turn in range(times):
        mover = site.movers[turn % len(site.movers)]
        for stop, took in ways.items():
            call = asyncio.ensure_future(client.call_tool("run_policy", mover.wave))
            await mover.until(True)
            began = time.monotonic()
            await stop(mover.name)
            answered = time.monotonic()
            took.append((answered - began) * 1000)
            await call
            after += stop is by_server and sum(write > answered for write in mover.world.writes)
    for other in others:
        other.cancel()
    await asyncio.wait(others)
    bare, ours = (p99(took) for took in ways.values())
    median = sorted(ways[by_server])[times // 2]
    text = f"p50 {median:.0f} ms, p99 {ours:.0f} ms, {after} writes after the answer"
    must = f"p99 <= {STOP_MS:.0f} ms, no write after"
    against = f"p99 {bare:.0f} ms without the server"
    return Row(f"`stop` while three tools run, {name}", text, against, ours / bare, must, ours <= STOP_MS and not after)


def p99(took: list[float]) -> float:
    return sorted(took)[min(len(took) - 1, int(len(took) * 0.99))]


async def cancelled(mover: Mover, client: Any) -> float:
    call = asyncio.ensure_future(client.call_tool("run_policy", mover.wave))

    async def give_up() -> None:
        call.cancel()
        await asyncio.wait([call])

    return await mover.last_write_ms(give_up)


async def timed_out(mover: Mover, client: Any) -> float:
    began = time.monotonic()
    call = asyncio.ensure_future(client.call_tool("run_policy", mover.wave, read_timeout_seconds=TIMEOUT_S))
    await mover.until(True)
    with contextlib.suppress(MCPError, TimeoutError):
        await call
    return await mover.last_write_after(began + TIMEOUT_S)


async def closed(mover: Mover, url: str) -> float:
    headers = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}
    async with httpx2.AsyncClient(headers=headers, timeout=30) as http:
        begun = await http.post(url, json=INITIALIZE)
        http.headers["mcp-session-id"] = begun.headers["mcp-session-id"]
        await http.post(url, json={"jsonrpc": "2.0", "method": "notifications/initialized"})
        params = {"name": "run_policy", "arguments": mover.wave}
        call = {"jsonrpc": "2.0", "id": 2, "method": "tools/call", "params": params}
        stream = http.stream("POST", url, json=call)
        await stream.__aenter__()
        took = await mover.last_write_ms(lambda: stream.__aexit__(None, None, None))
        # The server keeps so many sessions of a token: beyond them, one of another trial would end.
        (await http.delete(url)).raise_for_status()
        return took


async def killed(mover: Mover, start: Callable[..., Awaitable[int]], way: dict[str, Any]) -> float:
    process = await start(arguments=mover.wave, **way)

    async def give_up() -> None:
        os.kill(process, signal.SIGKILL)

    return await mover.last_write_ms(give_up)


async def killed_server(mover: Mover, site: Site) -> float:
    server = await asyncio.to_thread(RawServer(site).__enter__)
    try:
        server.send(server.call(1, "run_policy", {**LONG, "robot": mover.name}))

        async def give_up() -> None:
            server.process.kill()

        return await mover.last_write_ms(give_up)
    finally:
        server.__exit__()


async def pages() -> Row:
    """Measure every page of a list of robots whose fields are as long as they may be."""
    name, model = "r" * 120, 'a "model" ' * 6
    ids = [f"{name}{number:03}" for number in range(ROBOTS)]
    found = {each: (FoundRobot(each, "strands_robot" * 3, model, status="available"), None) for each in ids}
    networks: Any = SimpleNamespace(find=lambda: found, announced=tuple, missing={})
    access = ClientAccess(Caller(networks), approves=False, show_picture=lambda jpeg: "")
    standing = StandingController("bench", networks)
    server = build(lambda context: access, RobotResources(networks), Approvals(), standing)
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
