"""Fleets of idle robots: what one more costs, and an emergency stop of hundreds; beside bare runtimes on one loop."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port
from fixtures.zenoh_router import ZenohRouter

from benchmarks.fleet_children import GROUP, link_to
from benchmarks.table import Row
from strands_robots.device_connect import FleetClient, LinkConfig
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.safety.controller import SafetyController

ROOT = Path(__file__).parent.parent
BURST_S = 12.0
"""Seconds in which a device announces itself more often after its start."""


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    many, more, stops = (50, 75, 3) if quick else (100, 250, 20)
    idle_s = 5.0 if quick else 20.0
    rows: list[Row] = []
    for title, network in NETWORKS.items():
        with network() as (transport, endpoint):
            rows += _one_process(title, transport, endpoint, many, idle_s)
    with _nats() as (transport, endpoint):
        rows += _one_more(transport, endpoint, more)
        rows += _rounds(transport, endpoint, 4 if quick else 20)
    with _nats() as (transport, endpoint):
        rows += _hundreds(transport, endpoint, (4, 25) if quick else (8, 50), stops)
    return rows


@contextlib.contextmanager
def _nats() -> Iterator[tuple[str, str]]:
    with NatsServer() as server:
        yield "nats", server.url


@contextlib.contextmanager
def _router() -> Iterator[tuple[str, str]]:
    with ZenohRouter() as router:
        yield "zenoh", router.endpoint


@contextlib.contextmanager
def _peers() -> Iterator[tuple[str, str]]:
    yield "meet", str(free_port())


NETWORKS: dict[str, Callable[[], contextlib.AbstractContextManager[tuple[str, str]]]] = {
    "NATS": _nats,
    "Zenoh router": _router,
    "Zenoh D2D": _peers,
}


class Child:
    """A process with devices."""

    def __init__(self, kind: str, first: int, count: int, transport: str, endpoint: str, state: str = "") -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.fleet_children", kind, str(first), str(count), transport, endpoint],
            cwd=ROOT,
            env={**os.environ, **({"STRANDS_STATE_DIR": state} if state else {})},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.ask("end")
        try:
            self._process.wait(30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def ask(self, line: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()

    def facts(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        facts: dict[str, Any] = json.loads(self._process.stdout.readline())
        return facts


def _one_process(title: str, transport: str, endpoint: str, count: int, idle_s: float) -> Iterator[Row]:
    with Child("ours", 0, count, transport, endpoint) as child:
        mine = _joined_and_idle(child, idle_s)
    theirs = dict.fromkeys(mine, float("nan"))
    # Bare peers need descriptors by the square of their number; a process has 1,024, which is enough for 22 of them.
    if transport != "meet":
        with Child("bare", 0, count, transport, endpoint) as child:
            theirs = _joined_and_idle(child, idle_s)
    share, bare = count / 100, "" if math.isnan(theirs["join"]) else "bare"
    yield Row(
        f"{title}: CPU to join {count} devices in one process",
        f"{mine['join']:.2f} s",
        bare and f"bare runtimes on one loop {theirs['join']:.2f} s",
        _ratio(mine["join"], theirs["join"]),
        f"≤ {3 * share:g} s",
        mine["join"] <= 3 * share,
    )
    growth = mine["last"] / mine["first"]
    yield Row(
        f"{title}: the last {GROUP} of them against the second {GROUP}",
        f"{mine['last']:.2f} s against {mine['first']:.2f} s",
        bare and f"bare {theirs['last'] / theirs['first']:.1f} times",
        None,
        "≤ 1.5 times",
        growth <= 1.5,
    )
    yield Row(
        f"{title}: {count} idle devices in one process",
        f"{mine['share']:.1%} of a core",
        bare and f"bare {theirs['share']:.1%}",
        _ratio(mine["share"], theirs["share"]),
        f"≤ {10 * share:g} % of a core",
        mine["share"] <= 0.1 * share,
    )


def _ratio(ours: float, theirs: float) -> float | None:
    return None if math.isnan(theirs) else ours / theirs


def _joined_and_idle(child: Child, idle_s: float) -> dict[str, float]:
    marks = child.facts()["marks"]
    groups = [after["cpu"] - before["cpu"] for before, after in itertools.pairwise(marks)]
    time.sleep(BURST_S)
    child.ask(f"idle {idle_s}")
    # The first group starts the session and the plane besides.
    return {"join": sum(groups), "first": groups[1], "last": groups[-1], "share": child.facts()["share"]}


def _one_more(transport: str, endpoint: str, count: int) -> Iterator[Row]:
    with Child("ours", 0, count, transport, endpoint) as child:
        marks = child.facts()["marks"]
    last, before = marks[-1], marks[-2]
    mb, threads, fds = ((last[key] - before[key]) / GROUP for key in ("mb", "threads", "fds"))
    yield Row(
        f"NATS: one more idle device, at {count} in a process",
        f"{mb:.2f} MB, {threads:.1f} threads, {fds:.1f} descriptors",
        "",
        None,
        "≤ 0.7 MB, 0 threads, ≤ 0.2 descriptors",
        mb <= 0.7 and threads <= 0.1 and fds <= 0.2,
    )


def _rounds(transport: str, endpoint: str, turns: int) -> Iterator[Row]:
    with Child("rounds", turns, 50, transport, endpoint) as child:
        marks = child.facts()["marks"]
    # The allocator keeps what the first rounds needed most.
    first, last = marks[len(marks) // 2], marks[-1]
    yield Row(
        f"NATS: left after {turns} rounds of 50 joins and leaves, against after half of them",
        ", ".join(f"{last[key] - first[key]:+.0f} {key}" for key in ("mb", "threads", "fds")),
        "",
        None,
        "≤ 5 MB, 0 threads, 0 descriptors",
        last["mb"] - first["mb"] <= 5 and last["threads"] <= first["threads"] and last["fds"] <= first["fds"],
    )


def _hundreds(transport: str, endpoint: str, shape: tuple[int, int], stops: int) -> Iterator[Row]:
    processes, each = shape
    count, link = processes * each, link_to(transport, endpoint)
    with tempfile.TemporaryDirectory(prefix="fleet-") as state, contextlib.ExitStack() as stack:
        children = [
            stack.enter_context(Child("ours", number * each, each, transport, endpoint, state))
            for number in range(processes)
        ]
        for child in children:
            child.facts()
        began = time.monotonic()
        with FleetClient(link, "bench") as fleet:
            found = 0
            while found < count and time.monotonic() < began + 30:
                found = len(fleet.peers(2.0))
            took = time.monotonic() - began
        yield Row(
            f"NATS: {count} devices in {processes} processes, found after the last start",
            f"{found} in {took:.1f} s",
            "",
            None,
            f"{count} in ≤ 10 s",
            found == count and took <= 10,
        )
        yield from _stops(link, children, count, stops, Path(state))


def _stops(link: LinkConfig, children: list[Child], count: int, stops: int, state: Path) -> Iterator[Row]:
    expected = [f"arm-{number}" for number in range(count)]
    halts, verdicts, answered = [], [], []
    controller = SafetyController("bench-safety", lambda: stop_link(link))
    try:
        for _ in range(stops):
            pressed = time.monotonic()
            report = controller.stop(expected, "bench", deadline_s=10.0)
            verdicts.append(report.elapsed_ms)
            answered.append(len(report.stopped))
            times: list[float] = []
            for child in children:
                child.ask("halts")
                times += child.facts()["halts"].values()
            halts.append((max(times, default=float("nan")) - pressed) * 1e3)
    finally:
        controller.close()
    stored = len(list(state.glob("lockouts/*")))
    yield Row(
        f"NATS: emergency stop to {count} devices, last halt, worst of {stops}",
        f"{max(halts):.0f} ms (p50 {statistics.median(halts):.0f})",
        "",
        None,
        "≤ 150 ms",
        max(halts) <= 150,
    )
    yield Row(
        f"NATS: every verdict of such a stop, worst of {stops}; lockouts on disk",
        f"{min(answered)} of {count} in {max(verdicts):.0f} ms; {stored}",
        "",
        None,
        f"{count} in ≤ 2 s; {count}",
        min(answered) == count and max(verdicts) <= 2000 and stored == count,
    )
