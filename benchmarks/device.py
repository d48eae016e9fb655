"""Bring-up, import, many robots in one process, and a stop while the robot blocks: ours and the bare framework."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from device_connect_edge import DeviceRuntime
from fixtures.echo_device import EchoDriver
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import free_port
from fixtures.zenoh_router import ZenohRouter

from benchmarks.table import Row
from strands_robots.device_connect import FleetClient, LinkConfig, init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.client import DeviceTimeoutError

ROOT = Path(__file__).parent.parent
IN_ONE_PROCESS = 32
BRING_UP_MOST = 1.2


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    logging.getLogger("device_connect_edge").addHandler(logging.NullHandler())
    logging.disable(logging.ERROR)
    try:
        return [
            *_bring_up(5 if quick else 20),
            _imports(5 if quick else 15),
            *_fleet(8 if quick else IN_ONE_PROCESS),
            _blocked_stop(3 if quick else 25),
            _stream(5.0 if quick else 60.0),
        ]
    finally:
        logging.disable(logging.NOTSET)


def _bring_up(repeats: int) -> Iterator[Row]:
    with ZenohRouter() as router:
        yield _to_discoverable("Zenoh router", repeats, LinkConfig(connect=(router.endpoint,)), "zenoh")
    with NatsServer() as server:
        link = LinkConfig(transport="nats", connect=(server.url,))
        yield _to_discoverable("NATS", repeats, link, "nats")
        yield _to_discoverable("NATS, further devices of the process", repeats, link, "nats", further=True)
    yield _to_discoverable("Zenoh D2D, multicast", repeats, LinkConfig(multicast=True), "zenoh")


def _to_discoverable(name: str, repeats: int, link: LinkConfig, backend: str, *, further: bool = False) -> Row:
    ours: list[float] = []
    bare: list[float] = []
    with FleetClient(link) as fleet, _discovery_by_presence(), contextlib.ExitStack() as stack:
        if further:
            stack.callback(_ours(link, "ours-first"))
        loop = stack.enter_context(_loop()) if further else None
        if loop is not None:
            stack.callback(_bare(link, backend, "bare-first", loop))
        for number in range(repeats + 1):
            # The first of each is warm-up.
            bare.append(_up(fleet, f"bare-{number}", lambda each: _bare(link, backend, each, loop)))
            ours.append(_up(fleet, f"ours-{number}", lambda each: _ours(link, each)))
    mine, theirs = statistics.median(ours[1:]), statistics.median(bare[1:])
    ratio = mine / theirs
    return Row(
        f"bring-up to discoverable, {name}",
        f"{mine * 1e3:.1f} ms",
        f"bare runtime{'s on one loop' if further else ''} {theirs * 1e3:.1f} ms",
        ratio,
        f"≤ {BRING_UP_MOST:g}",
        ratio <= BRING_UP_MOST,
    )


def _up(fleet: FleetClient, name: str, start: Callable[[str], Callable[[], object]]) -> float:
    """Return the seconds until a device is discovered; ``start`` returns what ends it."""
    # Both start from rest: a process that has just worked starts faster. A runtime has to be up before it is stopped.
    time.sleep(0.3)
    began = time.perf_counter()
    end = start(name)
    took = _until_known(fleet, name) - began
    time.sleep(0.3)
    end()
    return took


def _ours(link: LinkConfig, name: str) -> Callable[[], object]:
    # On a thread, because it returns later than the device can be discovered.
    pool = ThreadPoolExecutor(1)
    serving = pool.submit(init_device_connect_sync, ToyRobot(), peer_id=name, link=link, allow_insecure=True)
    pool.shutdown(wait=False)
    return lambda: stop_device_connect(serving.result())


def _bare(
    link: LinkConfig, backend: str, name: str, loop: asyncio.AbstractEventLoop | None = None
) -> Callable[[], object]:
    logging.getLogger(f"device_connect_edge.device.{name}").addHandler(logging.NullHandler())
    stack = contextlib.ExitStack()
    home = loop or stack.enter_context(_loop())

    async def begin() -> tuple[DeviceRuntime, asyncio.Task[None]]:
        runtime = DeviceRuntime(
            driver=EchoDriver(),
            device_id=name,
            messaging_backend=backend,
            messaging_urls=list(link.connect) or None,
            allow_insecure=True,
        )
        return runtime, asyncio.create_task(runtime.run())

    starting = asyncio.run_coroutine_threadsafe(begin(), home)

    async def finish() -> None:
        runtime, task = starting.result()
        await runtime.stop()
        await asyncio.gather(task, return_exceptions=True)

    def end() -> None:
        asyncio.run_coroutine_threadsafe(finish(), home).result(10)
        stack.close()

    return end


@contextlib.contextmanager
def _loop() -> Iterator[asyncio.AbstractEventLoop]:
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    yield loop
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10)
    loop.close()


def _until_known(fleet: FleetClient, name: str) -> float:
    deadline = time.perf_counter() + 10
    while name not in fleet.known():
        if time.perf_counter() > deadline:
            return float("nan")
        time.sleep(0.0005)
    return time.perf_counter()


@contextlib.contextmanager
def _discovery_by_presence() -> Iterator[None]:
    before = os.environ.get("DEVICE_CONNECT_DISCOVERY_MODE")
    os.environ["DEVICE_CONNECT_DISCOVERY_MODE"] = "d2d"
    yield
    if before is None:
        del os.environ["DEVICE_CONNECT_DISCOVERY_MODE"]
    else:
        os.environ["DEVICE_CONNECT_DISCOVERY_MODE"] = before


def _imports(repeats: int) -> Row:
    def median(program: str) -> float:
        took = []
        for _ in range(repeats):
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True)
            took.append(time.perf_counter() - began)
        return statistics.median(took)

    nothing = median("pass")
    ours = median("import strands_robots.device_connect") - nothing
    theirs = median("import device_connect_edge") - nothing
    return Row(
        "import strands_robots.device_connect",
        f"{ours * 1e3:.1f} ms",
        f"device_connect_edge {theirs * 1e3:.0f} ms",
        ours / theirs,
        "≤ 0.08",
        ours / theirs <= 0.08,
    )


def _fleet(count: int) -> Iterator[Row]:
    ours = _child("fleet-ours", str(count), str(free_port()))
    theirs = _child("fleet-bare", str(count))
    share = count / IN_ONE_PROCESS
    for what, unit, bound in (("mb", " MB", 120), ("threads", " threads", 80), ("fds", " descriptors", 200)):
        mine = ours["after"][what] - (ours["before"][what] if what == "mb" else 0)
        bare = theirs["after"][what] - (theirs["before"][what] if what == "mb" else 0)
        yield Row(
            f"{count} robots in one process{', what joining the network adds' if what == 'mb' else ''}",
            f"{mine:.0f}{unit}",
            f"{count} bare runtimes {bare:.0f}{unit}",
            mine / bare if bare else None,
            f"≤ {bound}{unit}",
            mine <= bound * max(share, 0.5),
        )


def _blocked_stop(repeats: int) -> Row:
    ours = sorted(_stops_while_blocked("ours", repeats))
    bare = _stops_while_blocked("bare", 2)
    worst = ours[-1] if len(ours) < 100 else ours[int(len(ours) * 0.99)]
    return Row(
        "stop answered while a handler's robot call blocks 2 s, p99",
        f"{worst * 1e3:.1f} ms",
        f"bare driver {statistics.median(bare) * 1e3:.0f} ms",
        worst / statistics.median(bare),
        "≤ 20 ms",
        worst <= 0.020,
    )


def _stream(seconds: float) -> Row:
    """A 50 Hz task from its first step to its last, as another connection receives it."""
    robot, received = ToyRobot("stream"), []
    link = LinkConfig(mode="peer", meet_port=free_port(), multicast=False)
    runtime = init_device_connect_sync(robot, peer_id="stream", link=link)
    try:
        with FleetClient(link, "bench") as fleet, fleet.subscription("stream", received.append):
            robot.start_task("stream", duration=seconds)
            deadline = time.monotonic() + seconds + 10
            while not any(event.name == "taskComplete" for event in received) and time.monotonic() < deadline:
                time.sleep(0.1)
    finally:
        stop_device_connect(runtime)
        robot.close()
    steps = robot.rollouts["stream"].steps
    streamed = [event.payload["step"] for event in received if event.name == "streamStep"]
    lost = steps - len(streamed)
    updates = sum(event.name == "stateUpdate" for event in received) / seconds
    return Row(
        f"streamStep of a 50 Hz task over {seconds:.0f} s, lost",
        f"{lost} of {steps}, in order: {streamed == sorted(streamed)}; stateUpdate {updates:.1f} Hz",
        "",
        None,
        "0",
        lost == 0 and streamed == sorted(streamed),
    )


def _stops_while_blocked(kind: str, blocks: int) -> list[float]:
    port = free_port()
    environment = {"DEVICE_CONNECT_RPC_ALLOW": "bench", "BYPASS_TOOL_CONSENT": "true"}
    link = LinkConfig(mode="peer", meet_port=port, multicast=False)
    if kind == "bare":
        environment |= {"ZENOH_LISTEN": f"tcp/127.0.0.1:{port}"}
        link = LinkConfig(connect=(f"tcp/127.0.0.1:{port}",), mode="peer", multicast=False)
    took: list[float] = []
    with _serving(kind, port, environment), FleetClient(link, "bench") as fleet:
        for _ in range(blocks):
            blocked = threading.Thread(target=_ignoring(lambda: fleet.call("slow", "execute", {"instruction": "x"})))
            blocked.start()
            time.sleep(0.3)
            for _ in range(8 if kind == "ours" else 1):
                began = time.perf_counter()
                fleet.call("slow", "stop")
                took.append(time.perf_counter() - began)
            blocked.join()
            with contextlib.suppress(DeviceTimeoutError):
                fleet.call("slow", "stop")
    return took


def _ignoring(work: Callable[[], object]) -> Callable[[], None]:
    def quietly() -> None:
        with contextlib.suppress(TimeoutError):
            work()

    return quietly


@contextlib.contextmanager
def _serving(kind: str, port: int, environment: dict[str, str]) -> Iterator[None]:
    command = [sys.executable, "-m", "benchmarks.device_children", "blocking", kind, str(port)]
    child = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, **environment},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdin is not None
    child.stdout.readline()
    try:
        yield
    finally:
        child.stdin.close()
        try:
            child.wait(5)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _child(*arguments: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.device_children", *arguments]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=True)
    facts: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return facts
