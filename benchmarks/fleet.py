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
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port
from fixtures.zenoh_router import ZenohRouter

from benchmarks.fleet_children import GROUP, link_to
from benchmarks.table import Row
from strands_robots.device_connect import FleetClient, LinkConfig
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.safety.controller import SafetyController

T = TypeVar("T")
ROOT = Path(__file__).parent.parent
BURST_S = 12.0
"""Seconds in which a device announces itself more often after its start."""


IDLE_MOST = 0.1
"""Share of a core that 100 idle devices may take."""


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table; some four minutes a network.

    ``FLEET_PARTS`` and ``FLEET_NETWORKS``, with commas, choose from them: ``rounds,one_more`` and ``NATS``.
    """
    size = Size(50, 75, (4, 25), 3, 6, 4.0) if quick else Size(100, 250, (8, 50), 20, 60, 10.0)
    parts, networks = _chosen("FLEET_PARTS", PARTS), _chosen("FLEET_NETWORKS", NETWORKS)
    rows: list[Row] = []
    for title, network in networks.items():
        for part in parts.values():
            # A network of its own: what the part before left at it is no part of the next one.
            with network() as (transport, endpoint):
                rows += part(Network(title, transport, endpoint), size)
    return rows


def _chosen(variable: str, known: Mapping[str, T]) -> Mapping[str, T]:
    names = os.environ.get(variable, "").split(",")
    return {name: known[name] for name in names} if names != [""] else known


class Size(NamedTuple):
    """How much is measured."""

    many: int
    more: int
    fleet: tuple[int, int]
    stops: int
    rounds: int
    idle_s: float


class Network(NamedTuple):
    """Where devices meet: title of its rows, kind and endpoint."""

    title: str
    transport: str
    endpoint: str

    def child(self, kind: str, first: int, count: int, state: str = "") -> Child:
        return Child(kind, first, count, self.transport, self.endpoint, state)

    def row(self, what: str, ours: str, must: str, ok: bool, bare: str = "", ratio: float = math.nan) -> Row:
        return Row(f"{self.title}: {what}", ours, bare, None if math.isnan(ratio) else ratio, must, ok)


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


def _one_process(network: Network, size: Size) -> Iterator[Row]:
    count, share = size.many, size.many / 100
    with network.child("ours", 0, count) as child:
        mine = _joined_and_idle(child, size.idle_s)
    theirs = dict.fromkeys(mine, math.nan)
    # Bare peers need descriptors by the square of their number; a process has 1,024, which is enough for 22 of them.
    compared = network.transport != "meet"
    if compared:
        with network.child("bare", 0, count) as child:
            theirs = _joined_and_idle(child, size.idle_s)
    yield network.row(
        f"CPU to join {count} devices in one process",
        f"{mine['join']:.2f} s",
        f"≤ {3 * share:g} s",
        mine["join"] <= 3 * share,
        f"bare runtimes on one loop {theirs['join']:.2f} s" if compared else "",
        mine["join"] / theirs["join"],
    )
    growth = mine["last"] / mine["first"]
    yield network.row(
        f"the last {GROUP} of them against the second {GROUP}, without full collections of garbage",
        f"{mine['last']:.2f} s against {mine['first']:.2f} s",
        "≤ 1.5 times",
        growth <= 1.5,
        f"bare {theirs['last'] / theirs['first']:.1f} times" if compared else "",
    )
    yield network.row(
        f"{count} idle devices in one process",
        f"{mine['share']:.1%} of a core",
        f"≤ {IDLE_MOST * share:.0%} of a core",
        mine["share"] <= IDLE_MOST * share,
        f"bare {theirs['share']:.1%}" if compared else "",
        mine["share"] / theirs["share"],
    )


def _joined_and_idle(child: Child, idle_s: float) -> dict[str, float]:
    facts = child.facts()
    marks = facts["marks"]
    groups = [after["cpu"] - before["cpu"] for before, after in itertools.pairwise(marks)]
    time.sleep(BURST_S)
    child.ask(f"idle {idle_s}")
    # The first group starts the session and the plane besides.
    join = sum(groups) + facts["collected"]
    return {"join": join, "first": groups[1], "last": groups[-1], "share": child.facts()["share"]}


def _processes(network: Network, size: Size) -> Iterator[Row]:
    processes = size.many // GROUP
    with contextlib.ExitStack() as stack:
        children = [stack.enter_context(network.child("ours", each * GROUP, GROUP)) for each in range(processes)]
        for child in children:
            child.facts()
        time.sleep(BURST_S)
        for child in children:
            child.ask(f"idle {size.idle_s}")
        share = sum(child.facts()["share"] for child in children)
    most = IDLE_MOST * size.many / 100
    yield network.row(
        f"{processes} processes of {GROUP} idle devices, in all",
        f"{share:.1%} of a core",
        f"≤ {most:.0%} of a core",
        share <= most,
    )


def _one_more(network: Network, size: Size) -> Iterator[Row]:
    with network.child("settled", 0, size.more) as child:
        marks = child.facts()["marks"]
    for at in (1, len(marks) - 2):
        before, after = marks[at], marks[at + 1]
        mb, threads, fds = ((after[key] - before[key]) / GROUP for key in ("mb", "threads", "fds"))
        yield network.row(
            f"one more idle device, from {at * GROUP} to {(at + 1) * GROUP} in a process",
            f"{mb:.2f} MB, {threads:.2f} threads, {fds:.2f} descriptors",
            "≤ 0.7 MB, 0 threads, ≤ 0.2 descriptors",
            mb <= 0.7 and threads <= 0 and fds <= 0.2,
        )


def _rounds(network: Network, size: Size) -> Iterator[Row]:
    with network.child("rounds", size.rounds, 50) as child:
        marks = child.facts()["marks"]
    # The first rounds fill pools and the allocator's arenas; a leak goes on after them.
    first, last = marks
    new = list((Counter(last.pop("names")) - Counter(first.pop("names"))).elements())
    more = {key: last[key] - first[key] for key in last}
    rounds = size.rounds - size.rounds // 3
    yield network.row(
        f"left by the last {rounds} of {size.rounds} rounds of 50 joins and leaves",
        f"{more['mb']:+.1f} MB, {more['threads']:+.0f} threads{new or ''}, {more['fds']:+.0f} descriptors, "
        f"{more['objects']:+.0f} objects",
        "≤ 5 MB, 0 threads, 0 descriptors, not an object a device",
        more["mb"] <= 5 and more["threads"] <= 0 and more["fds"] <= 0 and more["objects"] < 50 * rounds,
    )


def _hundreds(network: Network, size: Size) -> Iterator[Row]:
    processes, each = size.fleet
    count, link = processes * each, link_to(network.transport, network.endpoint)
    with tempfile.TemporaryDirectory(prefix="fleet-") as state, contextlib.ExitStack() as stack:
        children = [
            stack.enter_context(network.child("ours", number * each, each, state)) for number in range(processes)
        ]
        for child in children:
            child.facts()
        began = time.monotonic()
        agent = stack.enter_context(network.child("agent", 0, count))
        with FleetClient(link, "bench") as fleet:
            found = 0
            while found < count and time.monotonic() < began + 30:
                found = len(fleet.peers(2.0))
            took = time.monotonic() - began
        yield network.row(
            f"{count} devices in {processes} processes, found after the last start",
            f"{found} in {took:.1f} s",
            f"{count} in ≤ 10 s",
            found == count and took <= 10,
        )
        # Its start, with the import of its packages, is part of the time.
        facts = agent.facts()
        took = facts["found_at"] - began
        yield network.row(
            "the same, by a bare agent, which calls each of them",
            f"{facts['found']} in {took:.1f} s, {facts['called']} answered",
            f"{count} in ≤ 10 s, {count} answered",
            facts["found"] == facts["called"] == count and took <= 10,
        )
        yield from _stops(network, link, children, size, Path(state))


def _stops(network: Network, link: LinkConfig, children: list[Child], size: Size, state: Path) -> Iterator[Row]:
    count, stops = math.prod(size.fleet), size.stops
    expected = [f"arm-{number}" for number in range(count)]
    halts, verdicts, answered = [], [], []
    controller = SafetyController("bench-safety", lambda: stop_link(link))
    try:
        controller.wait_link(10.0)
        for _ in range(stops):
            pressed = time.monotonic()
            report = controller.stop(expected, "bench", deadline_s=10.0)
            verdicts.append(report.elapsed_ms)
            answered.append(len(report.stopped))
            times: list[float] = []
            for child in children:
                child.ask("halts")
                times += child.facts()["halts"].values()
            halts.append((max(times, default=math.nan) - pressed) * 1e3)
    finally:
        controller.close()
    stored = len(list(state.glob("lockouts/*.json")))
    yield network.row(
        f"emergency stop to {count} devices, last halt, worst of {stops}",
        f"{max(halts):.0f} ms (p50 {statistics.median(halts):.0f})",
        "≤ 150 ms",
        max(halts) <= 150,
    )
    yield network.row(
        f"every verdict of such a stop, worst of {stops}; lockouts on disk",
        f"{min(answered)} of {count} in {max(verdicts):.0f} ms; {stored}",
        f"{count} in ≤ 2 s; {count}",
        min(answered) == count and max(verdicts) <= 2000 and stored == count,
    )


PARTS = {
    "one_process": _one_process,
    "processes": _processes,
    "one_more": _one_more,
    "rounds": _rounds,
    "hundreds": _hundreds,
}
