"""A call through a RemoteRobot beside the same call of the client below it, in turns."""

from __future__ import annotations

import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fixtures.waiting import eventually, free_port

from benchmarks.table import Row
from strands_robots import connect, settings
from strands_robots.device_connect import FleetClient, loopback_config

TURNS, CALLS, QUICK_CALLS = 5, 2_000, 300
BOUND = 1.1
EXAMPLE = Path(__file__).parent.parent / "examples" / "barista.py"


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    calls, port = QUICK_CALLS if quick else CALLS, free_port()
    settings.put("STRANDS_DC_PORT", str(port))
    settings.put("STRANDS_MESH_PORT", str(port))
    link = loopback_config(port)
    # The fleet has joined both networks, as it has wherever both extras are installed.
    with _own_robot() as name, FleetClient(link) as client, connect() as fleet:
        robot = eventually(lambda: name in fleet and fleet[name], what="the robot is found")
        sides: tuple[Callable[[], object], ...] = (robot.beans_left, lambda: client.call(name, "beansLeft", {}))
        ours, against = (
            statistics.median(turn) for turn in zip(*(_turn(sides, calls) for _ in range(TURNS)), strict=True)
        )
    ratio = ours / against
    return [
        Row(
            f"a read of a robot of one's own, by RemoteRobot beside FleetClient.call, Zenoh D2D, {calls} calls, p50",
            f"{ours * 1000:.2f} ms",
            f"{against * 1000:.2f} ms",
            ratio,
            f"≤ {BOUND:g}",
            ratio <= BOUND,
        )
    ]


@contextmanager
def _own_robot() -> Iterator[str]:
    """Serve the example of a robot with verbs of its own, in a process of its own."""
    serving = subprocess.Popen([sys.executable, EXAMPLE], env=dict(os.environ), stderr=subprocess.DEVNULL)
    try:
        yield "barista"
    finally:
        serving.send_signal(signal.SIGINT)
        serving.wait()


def _turn(sides: tuple[Callable[[], object], ...], calls: int) -> list[float]:
    """Return the median of each side in seconds; they call in turns."""
    took: list[list[float]] = [[] for _ in sides]
    for number in range(calls):
        for place in range(len(sides)):
            side = (number + place) % len(sides)
            began = time.perf_counter()
            sides[side]()
            took[side].append(time.perf_counter() - began)
    return [statistics.median(each) for each in took]
