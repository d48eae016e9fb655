"""Reachy Mini under our driver, beside a bare ``websockets`` client."""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial

from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually, free_port
from websockets.sync.client import connect

from benchmarks.table import Row
from strands_robots.device_connect import (
    FleetClient,
    ReachyMiniDriver,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.drivers.reachy.target import HeadPose

SECONDS = 10.0

BARE_READER = """
import json, sys, time
from websockets.sync.client import connect
with connect(sys.argv[1], compression=None, ping_interval=None, proxy=None) as ws:
    ws.recv()
    before, end = time.process_time(), time.monotonic() + float(sys.argv[2])
    while time.monotonic() < end:
        json.loads(ws.recv())
    print(time.process_time() - before)
"""
OUR_READER = """
import sys, time
from strands_robots.drivers.reachy import ReachyDriver
reachy = ReachyDriver("127.0.0.1", api_port=int(sys.argv[1]))
reachy.connect()
time.sleep(1.0)
before, frames = time.process_time(), reachy.connection.feed.joint_frames
time.sleep(float(sys.argv[2]))
print(time.process_time() - before, reachy.connection.feed.joint_frames - frames)
reachy.disconnect()
"""


def run(quick: bool = False) -> list[Row]:
    """Measure and return the rows of the table."""
    calls, stops, restarts = (60, 10, 2) if quick else (400, 100, 5)
    with Daemon(Kind("1.13.0")) as daemon, _allowed(), _fleet(daemon) as (fleet, driver):
        rows = [_look(daemon, fleet, calls), _stop(daemon, fleet, driver, stops), _reconnect(daemon, driver, restarts)]
    with Daemon(Kind("1.13.0")) as daemon:
        return [*rows, _decode(daemon, 3.0 if quick else SECONDS), _serve(daemon, 1 if quick else 3)]


@contextlib.contextmanager
def _allowed() -> Iterator[None]:
    """Approve the benchmark's own calls."""
    names = {"DEVICE_CONNECT_RPC_ALLOW": "bench", "BYPASS_TOOL_CONSENT": "1"}
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(names)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextlib.contextmanager
def _fleet(daemon: Daemon) -> Iterator[tuple[FleetClient, ReachyMiniDriver]]:
    with FleetClient(loopback_config(free_port()), "bench") as fleet:
        driver = ReachyMiniDriver("127.0.0.1", api_port=daemon.port)
        runtime = init_device_connect_sync(driver, peer_id="head", link=fleet.link)
        try:
            eventually(lambda: driver.reachy.is_connected, 10.0, "joint data")
            yield fleet, driver
        finally:
            stop_device_connect(runtime)


def _look(daemon: Daemon, fleet: FleetClient, calls: int) -> Row:
    """Time ``look`` until its frame is at the daemon, beside a bare frame and a call."""
    bare, trips, ours = [], [], []
    url = f"ws://127.0.0.1:{daemon.port}/ws/sdk"
    with connect(url, compression=None, ping_interval=None, proxy=None) as ws:
        for i in range(calls):
            started = time.monotonic()
            ws.send(json.dumps({"type": "set_target", "head": HeadPose(roll=1e-4 * i).matrix()}))
            # The bare client reads too, as every client must.
            ws.recv()
            time.sleep(0.01)
            bare.append(_first_since(daemon, started) - started)
            before = time.monotonic()
            fleet.call("head", "getJoints", {})
            trips.append(time.monotonic() - before)
            started = time.monotonic()
            fleet.call("head", "look", {"pitch": 2.0 * (i % 2), "yaw": 1.0})
            time.sleep(0.01)
            ours.append(_first_since(daemon, started) - started)
    p50, against = statistics.median(ours), statistics.median(bare) + statistics.median(trips)
    ratio = p50 / against
    return Row(
        "`look` to the frame at the daemon, p50",
        f"{p50 * 1000:.2f} ms",
        f"{against * 1000:.2f} ms (bare frame {statistics.median(bare) * 1000:.2f} + round trip)",
        ratio,
        "≤ 1.1",
        ratio <= 1.1,
    )


def _first_since(daemon: Daemon, started: float) -> float:
    """Wait for the first head frame after ``started``; return its time of arrival."""

    def arrivals() -> list[float]:
        return [at for frame, at in daemon.arrivals(20) if at >= started and frame.get("head")]

    return eventually(arrivals, 2.0, "the frame at the daemon")[0]


def _stop(daemon: Daemon, fleet: FleetClient, driver: ReachyMiniDriver, stops: int) -> Row:
    """Time ``stopMotion`` until the last frame that the daemon receives."""
    late, answered = [], []
    for _ in range(stops):
        fleet.call("head", "shake", {})
        time.sleep(0.1)
        started = time.monotonic()
        assert fleet.call("head", "stopMotion", {})["stopped"] is True
        answered.append(time.monotonic() - started)
        time.sleep(0.08)
        late.append(max(0.0, max(at for _, at in daemon.arrivals(20)) - started))
    p99 = sorted(late)[min(len(late) - 1, round(0.99 * len(late)))] * 1000
    answer = sorted(answered)[min(len(answered) - 1, round(0.99 * len(answered)))] * 1000
    return Row(
        "`stopMotion` in a gesture to the last frame, p99",
        f"{p99:.1f} ms (answered in {answer:.1f} ms)",
        "",
        None,
        "≤ 50 ms",
        p99 <= 50,
    )


def _reconnect(daemon: Daemon, driver: ReachyMiniDriver, restarts: int) -> Row:
    """Time a restart until joint data arrives, beside a bare client that reconnects."""
    ours, bare = [], []
    for _ in range(restarts):
        before = driver.reachy.connection.connects
        started = time.monotonic()
        daemon.request("POST", "/api/daemon/restart")
        bare.append(_bare_data(daemon, started))
        eventually(partial(_reconnected, driver, before), 20.0, "reconnected")
        ours.append(time.monotonic() - started)
        time.sleep(1.0)
    worst = max(ours)
    return Row(
        "joint data again after a daemon's restart, worst",
        f"{worst:.2f} s",
        f"{max(bare):.2f} s (bare client that knows of it)",
        None,
        "≤ 3 s",
        worst <= 3,
    )


def _reconnected(driver: ReachyMiniDriver, before: int) -> bool:
    return driver.reachy.connection.connects > before


def _bare_data(daemon: Daemon, started: float) -> float:
    time.sleep(0.1)
    eventually(lambda: daemon.request("GET", "/api/daemon/status").json()["state"] == "running", 20.0, "running")
    with connect(f"ws://127.0.0.1:{daemon.port}/ws/sdk", compression=None, proxy=None) as ws:
        ws.recv()
        return time.monotonic() - started


def _decode(daemon: Daemon, seconds: float) -> Row:
    """Measure the processor time of a process that only reads the robot's stream."""
    url = f"ws://127.0.0.1:{daemon.port}/ws/sdk"
    bare = float(_child(BARE_READER, url, str(seconds)).split()[0]) / seconds
    spent, frames = _child(OUR_READER, str(daemon.port), str(seconds)).split()
    ours = float(spent) / seconds
    return Row(
        "joint stream decoded, share of a core",
        f"{ours:.2%} at {int(frames) / seconds:.0f} Hz, with the watch over the link",
        f"{bare:.2%} (bare client that decodes all)",
        ours / bare,
        "< 3 %",
        ours < 0.03,
    )


def _child(code: str, *arguments: str) -> str:
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    return done.stdout


def _serve(daemon: Daemon, times: int) -> Row:
    """Time the start of ``serve`` until the first answer of a connected head."""
    taken = []
    for _ in range(times):
        port = free_port()
        arguments = (
            f"serve reachy_mini --host 127.0.0.1 --set api_port={daemon.port} --peer-id head --port {port} --json"
        )
        with FleetClient(loopback_config(port), "bench") as fleet:
            started = time.monotonic()
            serving = subprocess.Popen(
                [sys.executable, "-m", "strands_robots.cli", *arguments.split()], stdout=subprocess.PIPE, text=True
            )
            try:
                assert serving.stdout is not None
                serving.stdout.readline()
                eventually(lambda: fleet.call("head", "getStatus", {})["connected"], 10.0, "connected")
                taken.append(time.monotonic() - started)
            finally:
                serving.terminate()
                serving.communicate(timeout=15)
    p50 = statistics.median(taken)
    return Row("`serve` to the first call of a connected head", f"{p50:.2f} s", "", None, "≤ 2 s", p50 <= 2)
