"""Programs of their own for :mod:`benchmarks.device`: ``python -m benchmarks.device_children NAME ARGUMENT...``."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import resource
import sys
import threading
import time
from typing import Any

import psutil
from device_connect_edge import DeviceRuntime
from device_connect_edge.drivers import DeviceDriver, rpc
from fixtures.echo_device import EchoDriver
from fixtures.toy_robots import ToyRobot

from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect


class BlockingDriver(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """The bare framework with a robot call that blocks, as a first driver is often written."""

    device_type = "blocking"

    @rpc()  # type: ignore[untyped-decorator]
    async def execute(self, instruction: str = "") -> dict[str, Any]:
        """Block the loop for 2 s.

        Args:
            instruction: anything
        """
        time.sleep(2.0)  # noqa: ASYNC251 - the point of it
        return {}

    @rpc()  # type: ignore[untyped-decorator]
    async def stop(self) -> dict[str, Any]:
        """Answer at once."""
        return {"stopped": True}


def bare_runtime(driver: DeviceDriver, device_id: str) -> DeviceRuntime:
    """A stock runtime, quiet, on what the environment says."""
    logging.getLogger(f"device_connect_edge.device.{device_id}").addHandler(logging.NullHandler())
    return DeviceRuntime(driver=driver, device_id=device_id, allow_insecure=True)


def resources() -> dict[str, float]:
    """Memory in MB, threads and descriptors of this process."""
    me = psutil.Process()
    return {"mb": me.memory_info().rss / 1e6, "threads": me.num_threads(), "fds": me.num_fds()}


def report(**facts: Any) -> None:
    print(json.dumps(facts), flush=True)


def fleet_ours(count: int, port: int) -> None:
    """``count`` robots through ``init_device_connect_sync`` on one link."""
    warm = init_device_connect_sync(ToyRobot(), peer_id="warm", link=loopback_config(port))
    stop_device_connect(warm)
    robots = [ToyRobot(f"arm-{number}") for number in range(count)]
    before = resources()
    runtimes = [init_device_connect_sync(r, peer_id=r.tool_name_str, link=loopback_config(port)) for r in robots]
    time.sleep(5.0)
    report(before=before, after=resources())
    for runtime in runtimes:
        stop_device_connect(runtime)


def fleet_bare(count: int) -> None:
    """``count`` stock runtimes in one loop, on multicast or on what the environment says."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(8192, hard) if hard > 0 else 8192, hard))

    async def run() -> None:
        before = resources()
        tasks = [asyncio.create_task(bare_runtime(EchoDriver(), f"bare-{n}").run()) for n in range(count)]
        await asyncio.sleep(8.0 + count / 8)
        report(before=before, after=resources())
        os._exit(0)
        await asyncio.gather(*tasks)

    asyncio.run(run())


def serve_blocking(kind: str, port: int) -> None:
    """A device whose ``execute`` blocks 2 s in the robot, until standard input closes."""
    if kind == "ours":
        robot = ToyRobot("slow")
        robot.before["start_task"] = lambda: time.sleep(2.0)
        runtime = init_device_connect_sync(robot, peer_id="slow", link=loopback_config(port))
        report(up=True)
        sys.stdin.read()
        stop_device_connect(runtime)
        return
    device = bare_runtime(BlockingDriver(), "slow")
    threading.Thread(target=lambda: asyncio.run(device.run()), daemon=True).start()
    time.sleep(2.0)
    report(up=True)
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    name, *arguments = sys.argv[1:]
    if name == "fleet-ours":
        fleet_ours(int(arguments[0]), int(arguments[1]))
    elif name == "fleet-bare":
        fleet_bare(int(arguments[0]))
    else:
        serve_blocking(arguments[0], int(arguments[1]))
