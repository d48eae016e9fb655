"""Many devices in one process, for :mod:`benchmarks.fleet`: ``python -m benchmarks.fleet_children KIND ...``.

``KIND FIRST COUNT TRANSPORT ENDPOINT`` joins ``COUNT`` devices, reports, and then obeys lines on its standard input:
``idle SECONDS``, ``halts`` and ``end``. They are ``ours``, ``settled`` (idle at each mark) or ``bare``, the
framework's runtimes on one loop. ``agent`` finds ``COUNT`` devices with the framework's agent tools and calls each of
them; ``rounds`` joins and leaves.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import json
import logging
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
from device_connect_edge import DeviceRuntime
from fixtures.echo_device import EchoDriver

from strands_robots.device_connect import LinkConfig, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.envelope import Envelope, success

GROUP = 25
HALTS: dict[str, float] = {}
FULL_PASSES = {"began": 0.0, "cpu": 0.0}
"""Seconds of CPU of Python's full collections: by the size of the process, one for each quarter that it grows by."""
IDLE_S = 3.0
"""Seconds after which the workers of the last joins have ended."""
POOLS_S = 12.0
"""The same for the threads that a network's own pools start on demand; those end after 10 s without work."""


class Idle:
    """The smallest robot: four methods; it notes when it was stopped."""

    def __init__(self, name: str) -> None:
        self.tool_name_str = name

    def start_task(self, instruction: str, **options: Any) -> Envelope:
        return success("started")

    def stop_task(self) -> Envelope:
        HALTS[self.tool_name_str] = time.monotonic()
        return success("stopped")

    def get_task_status(self) -> Envelope:
        return success("idle", task_status="idle")

    def get_features(self) -> Envelope:
        return success("none")


def snapshot() -> dict[str, float]:
    me = psutil.Process()
    return {
        "cpu": time.process_time() - FULL_PASSES["cpu"],
        "mb": me.memory_info().rss / 1e6,
        "threads": me.num_threads(),
        "fds": me.num_fds(),
    }


def thread_names() -> list[str]:
    """Return the names of all threads, Python's and others'."""
    own = {each.native_id: each.name for each in threading.enumerate()}
    tasks = Path("/proc/self/task").iterdir()
    return sorted(own.get(int(each.name)) or (each / "comm").read_text().strip() for each in tasks)


def on_collection(phase: str, info: dict[str, int]) -> None:
    if info["generation"] == 2:
        now = time.thread_time()
        if phase == "start":
            FULL_PASSES["began"] = now
        else:
            FULL_PASSES["cpu"] += now - FULL_PASSES["began"]


def report(**facts: Any) -> None:
    print(json.dumps(facts), flush=True)


def link_to(transport: str, endpoint: str) -> LinkConfig:
    if transport == "meet":
        return loopback_config(int(endpoint))
    return LinkConfig(transport=transport, connect=(endpoint,))


def ours(first: int, count: int, link: LinkConfig, *, settled: bool = False) -> None:
    """Join devices; ``settled`` waits until they are idle after the first two groups and the last two."""
    gc.callbacks.append(on_collection)
    marks, runtimes = [snapshot()], []
    for number in range(first, first + count):
        name = f"arm-{number}"
        runtimes.append(init_device_connect_sync(Idle(name), peer_id=name, link=link, allow_insecure=True))
        if len(runtimes) % GROUP == 0:
            compared = len(runtimes) // GROUP in (1, 2, count // GROUP - 1, count // GROUP)
            time.sleep(IDLE_S if settled and compared else 0.0)
            marks.append(snapshot())
    report(marks=marks, collected=FULL_PASSES["cpu"])
    obey()
    for each in runtimes:
        stop_device_connect(each)
    report(after=snapshot())


def rounds(turns: int, count: int, link: LinkConfig) -> None:
    """Join and leave, again and again, under other names each time."""
    marks: list[dict[str, Any]] = []
    for turn in range(turns):
        names = [f"arm-{turn}-{each}" for each in range(count)]
        runtimes = [
            init_device_connect_sync(Idle(name), peer_id=name, link=link, allow_insecure=True) for name in names
        ]
        for each in runtimes:
            stop_device_connect(each)
        if turn + 1 in (turns // 3, turns):
            runtimes.clear()
            time.sleep(POOLS_S)
            gc.collect()
            # What the allocator keeps between two uses says nothing of who uses it.
            ctypes.CDLL(None).malloc_trim(0)
            marks.append({**snapshot(), "objects": len(gc.get_objects()), "names": thread_names()})
    report(marks=marks)


def bare(first: int, count: int, transport: str, endpoint: str) -> None:
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, daemon=True).start()
    marks = [snapshot()]

    async def join(name: str) -> None:
        logging.getLogger(f"device_connect_edge.device.{name}").addHandler(logging.NullHandler())
        runtime = DeviceRuntime(
            driver=EchoDriver(),
            device_id=name,
            messaging_backend="nats" if transport == "nats" else "zenoh",
            messaging_urls=[endpoint],
            allow_insecure=True,
        )
        tasks.append(asyncio.ensure_future(runtime.run()))
        # The framework has no public sign that a runtime is up.
        while not runtime._background_tasks:  # noqa: ASYNC110
            await asyncio.sleep(0.001)

    tasks: list[asyncio.Future[None]] = []
    for number in range(first, first + count):
        asyncio.run_coroutine_threadsafe(join(f"bare-{number}"), loop).result(60.0)
        if (number - first + 1) % GROUP == 0:
            marks.append(snapshot())
    report(marks=marks, collected=0.0)
    obey()
    os._exit(0)


def agent(count: int, transport: str, endpoint: str) -> None:
    """Find and call as a bare agent does."""
    if transport == "nats":
        os.environ.update(MESSAGING_BACKEND="nats", NATS_URL=endpoint)
    else:
        os.environ["ZENOH_CONNECT"] = f"tcp/127.0.0.1:{endpoint}" if transport == "meet" else endpoint
    import device_connect_agent_tools as tools  # noqa: PLC0415 - it reads the environment

    tools.connect()
    found: set[str] = set()
    until = time.monotonic() + 30
    while len(found) < count and time.monotonic() < until:
        found |= {each["device_id"] for each in tools.discover_devices() if each["device_id"].startswith("arm-")}
        time.sleep(0.05)
    found_at = time.monotonic()
    answers = (tools.invoke_device(each, "getStatus", {}) for each in sorted(found))
    report(found=len(found), found_at=found_at, called=sum(bool(each.get("success")) for each in answers))
    obey()
    os._exit(0)


def obey() -> None:
    for line in sys.stdin:
        command, *arguments = line.split()
        if command == "idle":
            before, began = snapshot(), time.monotonic()
            time.sleep(float(arguments[0]))
            after = snapshot()
            report(share=(after["cpu"] - before["cpu"]) / (time.monotonic() - began), **after)
        elif command == "halts":
            halts = dict(HALTS)
            HALTS.clear()
            report(halts=halts)
        else:
            return


def main() -> None:
    logging.disable(logging.ERROR)
    os.environ["DEVICE_CONNECT_DISCOVERY_MODE"] = "d2d"
    kind, first, count, transport, endpoint = sys.argv[1:]
    if kind == "bare":
        bare(int(first), int(count), transport, endpoint)
    elif kind == "agent":
        agent(int(count), transport, endpoint)
    else:
        link = link_to(transport, endpoint)
        if kind == "rounds":
            rounds(int(first), int(count), link)
        else:
            ours(int(first), int(count), link, settled=kind == "settled")


if __name__ == "__main__":
    main()
