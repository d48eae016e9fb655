"""From the controller's call to the last write of the last robot: ours and the bare framework, by condition.

The arms write at 500 Hz (one robot) or 50 Hz (many). The figure is the end of the last write or the moment from which
no further one may begin, whichever is later. All processes of a machine share the monotonic clock.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.stop_robots import robots
from fixtures.waiting import eventually, free_port

from benchmarks.safety_far import far_rows
from benchmarks.safety_raw import publish_to_callback
from benchmarks.table import Row
from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.safety import ed25519

STOPS, STOPS_QUICK, STOPS_BARE, STOPS_BARE_SLOW = 200, 20, 30, 2
LOST_AFTER_S = 5.0
ASKED_EVERY_S = 0.02
SETTLED_S = 0.04
"""From the first write of every arm to the stop: what their starts told the network is over by then."""

BLOCK_S = 2.0
QUIET = {"STRANDS_DC_STREAM_HZ": "0.01", "STRANDS_DC_STATE_BUSY_HZ": "1"}
"""Our robots tell as little as the bare ones, which tell nothing; one row has them tell all they do."""
BUSY = "while True: pass"


class Fleet:
    """Some processes of robots and one controller, ours or bare, on one transport."""

    def __init__(
        self,
        kind: str,
        transport: str,
        url: str,
        processes: int,
        each: int,
        settings: Mapping[str, str] | None = None,
        seed: str = "",
    ) -> None:
        self.kind, self.transport = kind, transport
        self.names = [[f"r-{p}-{n}" for n in range(each)] for p in range(processes)]
        self.everyone = [name for part in self.names for name in part]
        self._hz = 500.0 if len(self.everyone) == 1 else 50.0
        self._url = url
        self._stack = ExitStack()
        self.sites: list[Child] = []
        self.hand: Child
        self.forger: Child | None = None
        self._settings, self._seed = settings or {}, seed

    def __enter__(self) -> Self:
        state = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-safety-"))
        Path(state).chmod(0o700)
        environment = {"STRANDS_STATE_DIR": state, **QUIET, **self._settings}
        if self.kind == "ours":
            nats = LinkConfig(transport="nats", connect=(self._url,)) if self.transport == "nats" else None
            link = nats or loopback_config(free_port())
            self.sites = [self._enter(robots(link, *part, hz=self._hz, environment=environment)) for part in self.names]
            self.hand = self._enter(controller(link, seed=self._seed, environment=environment))
            if self._seed:
                self.forger = self._enter(controller(link, "forger", environment=environment))
            eventually(lambda: self.hand.ask("up") and all(site.ask("ready") for site in self.sites), 20, "every link")
        else:
            order: dict[str, Any] = {
                "backend": self.transport,
                "urls": [self._url] if self._url else [],
                "id": "safety-1",
            }
            order |= {"hz": self._hz, "tenant": f"bench{os.getpid()}"}
            module = "benchmarks.safety_bare"
            self.sites = [self._enter(Child(module, {**order, "robots": part}, environment)) for part in self.names]
            self.hand = self._enter(Child(module, {**order, "robots": []}, environment))
        eventually(self._rehearsed, 30, f"the first stop of {self.kind} on {self.transport}")
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _enter(self, child: Child) -> Child:
        return self._stack.enter_context(child)

    def _rehearsed(self) -> bool:
        return self.stop_once(patience=1.0) is not None

    def facts(self) -> dict[str, Any]:
        """Reports of every arm."""
        return {name: each for site in self.sites for name, each in site.ask("facts").items()}

    def stop_once(self, arrange: Callable[[], object] = lambda: None, patience: float = LOST_AFTER_S) -> float | None:
        """Seconds from the call until the last robot was still; None when one of them never was."""
        wanted = self.everyone
        for site in self.sites:
            site.ask("move")
        time.sleep(SETTLED_S)
        arrange()
        at: float = self.hand.ask("stop", wanted, patience)["at"]
        deadline = time.monotonic() + patience
        while True:
            # Ours has answered by now; the bare framework does not answer and is not to be asked while it stops.
            time.sleep(0.0 if self.kind == "ours" else ASKED_EVERY_S)
            told = self.facts()
            if all(told[name]["still"] > at for name in wanted) or time.monotonic() > deadline:
                break
        for site in self.sites:
            site.ask("clear" if self.kind == "ours" else "halt")
        if any(told[name]["still"] < at for name in wanted):
            return None
        return max(float(told[name]["still"]) for name in wanted) - at

    def stops(self, count: int, arrange: Callable[[], object] = lambda: None, **options: Any) -> Figures:
        """The figures of so many stops."""
        return Figures([self.stop_once(arrange, **options) for _ in range(count)])


@dataclass
class Figures:
    """Seconds of many stops; None for one that never came."""

    took: list[float | None] = field(default_factory=list)

    @property
    def lost(self) -> int:
        return sum(each is None for each in self.took)

    def quantile(self, share: float) -> float:
        """The value that this share of the stops kept; infinite where those were lost."""
        ordered = sorted(float("inf") if each is None else each for each in self.took)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))]

    def text(self) -> str:
        lost = f", {self.lost} never" if self.lost else ""
        p50, p99 = (f"{self.quantile(share) * 1e3:.1f}" for share in (0.5, 0.99))
        return f"p50 {p50} p99 {p99} ms of {len(self.took)}{lost}"


def row(what: str, ours: Figures, bare: Figures | None, bound_s: float, more: str = "", held: bool = True) -> Row:
    """One condition; the ratio is that of the medians."""
    ratio = None
    if bare is not None and bare.quantile(0.5) not in (0.0, float("inf")):
        ratio = ours.quantile(0.5) / bare.quantile(0.5)
    return Row(
        what,
        ours.text(),
        f"bare framework {bare.text()}" if bare is not None else "",
        ratio,
        f"p99 ≤ {bound_s * 1e3:.0f} ms{more}",
        ours.quantile(0.99) <= bound_s and not ours.lost and held,
    )


class Hiccups(threading.Thread):
    """Lateness of a thread that sleeps for a millisecond on this machine; every figure here contains it."""

    def __init__(self) -> None:
        super().__init__(name="hiccups", daemon=True)
        self._end = threading.Event()
        self._late: list[float | None] = []

    def run(self) -> None:
        while not self._end.wait(0.05):
            due = time.monotonic() + 0.001
            time.sleep(0.001)
            self._late.append(time.monotonic() - due)

    def row(self) -> Row:
        """The row of the table."""
        return Row(
            "this machine meanwhile: a sleep of 1 ms is late by", Figures(self._late).text(), "", None, "", ok=True
        )

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self.join()


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    stops = STOPS_QUICK if quick else STOPS
    rows: list[Row] = []
    with Hiccups() as machine, NatsServer() as server:
        for transport, url, name in (("zenoh", "", "Zenoh D2D"), ("nats", server.url, "NATS")):
            rows += [*_at_rest(transport, url, name, stops), *_crowds(transport, url, name, stops)]
            rows += _held_up(transport, url, name, stops)
    return [*rows, *far_rows(20 if quick else 500), machine.row()]


def _both(
    transport: str, url: str, processes: int, each: int, measure: Callable[[Fleet], Figures]
) -> Iterator[Figures]:
    for kind in ("ours", "bare"):
        with Fleet(kind, transport, url, processes, each) as fleet:
            yield measure(fleet)


def _at_rest(transport: str, url: str, name: str, stops: int) -> Iterator[Row]:
    ours, bare = _both(transport, url, 1, 1, lambda f: f.stops(stops if f.kind == "ours" else min(stops, STOPS_BARE)))
    raw = sorted(publish_to_callback(transport, url, stops))
    yield row(f"{name}: at rest, 1 robot", ours, bare, 0.003)
    floor, mine = statistics.median(raw), ours.quantile(0.5)
    yield Row(
        f"{name}: at rest, 1 robot, against the bare transport",
        f"p50 {mine * 1e3:.2f} ms",
        f"raw publish to callback p50 {floor * 1e3:.2f} p99 {raw[int(0.99 * len(raw))] * 1e3:.2f} ms",
        mine / floor,
        "≤ 4",
        mine <= 4 * floor,
    )


def _crowds(transport: str, url: str, name: str, stops: int) -> Iterator[Row]:
    for what, processes, each, bound in (("32 robots in one process", 1, 32, 0.013), ("4 processes of 8", 4, 8, 0.015)):
        ours, bare = _both(
            transport, url, processes, each, lambda f: f.stops(stops if f.kind == "ours" else min(stops, STOPS_BARE))
        )
        yield row(f"{name}: {what}, the last one still", ours, bare, bound)
    with Fleet("ours", transport, url, 1, 32, {"STRANDS_DC_STREAM_HZ": "50"}) as fleet:
        told = fleet.stops(stops).text()
    yield Row(f"{name}: 32 robots in one process, each publishing 50 steps a second", told, "", None, "", ok=True)


def _held_up(transport: str, url: str, name: str, stops: int) -> Iterator[Row]:
    def during(order: Callable[[Fleet], object], again_s: float) -> Callable[[Fleet], Figures]:
        def measure(fleet: Fleet) -> Figures:
            slow = fleet.kind == "bare"
            due = [0.0]

            def arrange() -> None:
                # Ours is stopped many times within one hold-up, the bare framework once.
                if slow or time.monotonic() >= due[0]:
                    order(fleet)
                    due[0] = time.monotonic() + again_s

            return fleet.stops(min(stops, STOPS_BARE_SLOW) if slow else stops, arrange, patience=again_s + LOST_AFTER_S)

        return measure

    conditions: list[tuple[str, int, float, Callable[[Fleet], object], float]] = [
        ("an RPC handler blocks the loop for 2 s", 8, 0.020, lambda f: f.sites[0].ask("block", BLOCK_S, 1), 1.8),
        ("each of 8 devices blocks the loop for 2 s", 8, 0.020, lambda f: f.sites[0].ask("block", BLOCK_S, 8), 15.5),
        ("the controller has 8 slow calls outstanding", 8, 0.010, _slow_calls, 1.8),
        ("the controller's process emits 10 kHz", 1, 0.020, lambda f: f.hand.ask("telemetry", 10_000.0, 2.0), 1.8),
    ]
    for what, count, bound, order, again_s in conditions:
        ours, bare = _both(transport, url, 1, count, during(order, again_s))
        yield row(f"{name}: {what}", ours, bare, bound)
    yield _wedged(transport, url, name, stops)
    yield _busy(transport, url, name, stops)
    yield _flooded(transport, url, name, stops)


def _slow_calls(fleet: Fleet) -> None:
    fleet.sites[0].ask("slow_reads", BLOCK_S)
    fleet.hand.ask("slow_calls", fleet.everyone)
    time.sleep(0.1)


def _wedged(transport: str, url: str, name: str, stops: int) -> Row:
    locked: list[bool] = []

    def measure(fleet: Fleet) -> Figures:
        victim, rest = fleet.everyone[0], fleet.everyone[1:]
        took: list[float | None] = []
        while len(took) < (max(2, stops // 40) if fleet.kind == "ours" else 1):
            fleet.sites[0].ask("move")
            fleet.sites[0].ask("wedge", victim, 5.0)
            took.append(_stop_the_rest(fleet, victim, rest, locked))
        return Figures(took)

    ours, bare = _both(transport, url, 1, 8, measure)
    named = f", wedged one locked and named in {sum(locked)} of {len(locked)}"
    return row(f"{name}: a motor-bus read hangs 5 s, the other 7 robots{named}", ours, bare, 0.020, held=all(locked))


def _stop_the_rest(fleet: Fleet, victim: str, rest: list[str], locked: list[bool]) -> float | None:
    report = fleet.hand.ask("stop", fleet.everyone, 2.0)
    told = fleet.facts()
    if fleet.kind == "ours":
        locked.append(told[victim]["locked"] and victim in report["not_stopped"])
    eventually(lambda: not fleet.facts()[victim]["moving"], 10, "the wedged read ends")
    told = fleet.facts()
    fleet.sites[0].ask("clear" if fleet.kind == "ours" else "halt")
    late = [told[name]["still"] for name in rest]
    return None if min(late) < report["at"] else max(late) - report["at"]


@contextmanager
def _beside() -> Iterator[None]:
    busy = subprocess.Popen([sys.executable, "-c", BUSY])
    try:
        yield
    finally:
        busy.kill()
        busy.wait()


def _busy(transport: str, url: str, name: str, stops: int) -> Row:
    def measure(fleet: Fleet) -> Figures:
        with _beside():
            fleet.sites[0].ask("busy", 2)
            figures = fleet.stops(stops if fleet.kind == "ours" else min(stops, STOPS_BARE))
            fleet.sites[0].ask("busy", 0)
            return figures

    ours, bare = _both(transport, url, 1, 1, measure)
    return row(f"{name}: two busy Python threads in the robot's process, one busy process beside it", ours, bare, 0.040)


def _flooded(transport: str, url: str, name: str, stops: int) -> Row:
    key = Ed25519PrivateKey.generate()
    seed = key.private_bytes_raw().hex()
    settings = {
        "DEVICE_CONNECT_ESTOP_ALLOW": "safety-*",
        "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS": ed25519.encode(ed25519.public_half(key)),
    }
    with Fleet("ours", transport, url, 1, 1, settings, seed) as fleet:
        due = [0.0]

        def arrange() -> None:
            if fleet.forger is not None and time.monotonic() >= due[0]:
                # One may not stop at all; the other may, but its signatures are forged.
                fleet.forger.ask("forge", ["forger", "safety-9"], 10_000.0, 5.0)
                due[0] = time.monotonic() + 4.9

        figures = fleet.stops(stops, arrange)
    return row(f"{name}: 10,000 forged stops a second beside the signed one", figures, None, 0.040)
