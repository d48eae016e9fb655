"""The mesh beside bare Zenoh: latency, rate, stops, idle cost and import."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import zenoh
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually, free_port

from benchmarks.mesh_children import REQUEST, raw_config
from benchmarks.table import Row
from strands_robots.mesh import init_mesh
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.input import InputPublisher

ROOT = Path(__file__).parent.parent
STATE = {
    "peer_id": "bench",
    "t": 1700000000.123456,
    "joints": {f"joint_{number}": 0.123456 + number for number in range(6)},
    "task": {"status": "idle", "steps": 0},
}


class Child:
    """A process of :mod:`benchmarks.mesh_children`."""

    def __init__(self, *arguments: str, **settings: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.mesh_children", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, **settings},
        )
        assert self._read() == {"ready": True}

    def ask(self, command: str = "") -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()
        return self._read()

    def _read(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate(timeout=10)


@contextmanager
def joined(robot: Any, peer_id: str) -> Iterator[Mesh]:
    mesh = init_mesh(robot, peer_id)
    assert mesh is not None and mesh.alive
    try:
        yield mesh
    finally:
        mesh.close()


def percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(len(values) * share))]


def run(quick: bool = False) -> list[Row]:
    """Every row of the mesh's table; ``quick`` measures a tenth."""
    with tempfile.TemporaryDirectory() as state, ExitStack() as stack:
        own, bare = str(free_port()), str(free_port())
        os.environ.update(STRANDS_MESH_PORT=own, STRANDS_STATE_DIR=state, STRANDS_MESH_AUDIT_DIR=f"{state}/audit")
        shared = {"STRANDS_MESH_PORT": own}
        console = stack.enter_context(joined(None, "console"))
        session = stack.enter_context(
            zenoh.open(zenoh.Config.from_json5(raw_config(f"tcp/127.0.0.1:{bare}", listen=True)))
        )
        echo = Child("echo", bare)
        stack.callback(echo.close)
        rows = [*pings(console, session, shared, 200 if quick else 2000), publishing(console, session, quick)]
        rows.append(teleoperation(console, session, echo, shared, 5 if quick else 60))
        rows += stops(console, shared, state, 10 if quick else 100)
        rows += losses(state)
        rows.append(presence(5 if quick else 20))
        rows += [*idle(shared, state), fleet_idle(state, 3 if quick else 20)]
    return rows


def pings(console: Mesh, session: Any, shared: dict[str, str], count: int) -> list[Row]:
    answered = threading.Event()
    subscriber = session.declare_subscriber(
        "strands/bench/answer", lambda sample: (json.loads(sample.payload.to_bytes()), answered.set())
    )
    ours: list[float] = []
    bare: list[float] = []
    with MeshPeer("echo", "none", shared) as peer:
        eventually(lambda: console.ping("echo", 0.5)["status"] == "ok", within=10)
        for _ in range(5):
            for _ in range(count // 5):
                started = time.perf_counter()
                assert console.ping("echo")["status"] == "ok"
                ours.append((time.perf_counter() - started) * 1000)
            for _ in range(count // 5):
                answered.clear()
                started = time.perf_counter()
                source = zenoh.SourceInfo(session.id, 0)
                session.put("strands/bench/ask", json.dumps(REQUEST).encode(), source_info=source)
                assert answered.wait(2)
                bare.append((time.perf_counter() - started) * 1000)
        assert peer.ask("alive")
    subscriber.undeclare()
    mine, raw = statistics.median(ours), statistics.median(bare)
    ratio = mine / raw
    return [Row("ping round trip, p50", f"{mine:.3f} ms", f"{raw:.3f} ms", ratio, "at most 2.0", ratio <= 2.0)]


def publishing(console: Mesh, session: Any, quick: bool) -> Row:
    count, ours, bare = 2_000 if quick else 20_000, [], []
    for _ in range(5):
        started = time.perf_counter()
        for _ in range(count):
            console.publish("strands/console/state", STATE)
        ours.append(count / (time.perf_counter() - started))
        started = time.perf_counter()
        for number in range(count):
            source = zenoh.SourceInfo(session.id, number)
            session.put("strands/console/state", json.dumps(STATE).encode(), source_info=source)
        bare.append(count / (time.perf_counter() - started))
    mine, raw = statistics.median(ours), statistics.median(bare)
    size = len(json.dumps(STATE))
    what = f"publish a state of {size} bytes, messages a second"
    return Row(what, f"{mine:,.0f}", f"{raw:,.0f}", mine / raw, "at least 0.85", mine / raw >= 0.85)


class Counter:
    """A leader whose action tells which frame it is, and when it was read."""

    def __init__(self) -> None:
        self.sent: list[float] = []

    def get_action(self) -> dict[str, float]:
        self.sent.append(time.time())
        return {"n": len(self.sent) / 1000}


def teleoperation(console: Mesh, session: Any, echo: Child, shared: dict[str, str], seconds: int) -> Row:
    follower, leader = Child("follow", "console", **shared), Counter()
    publisher = InputPublisher(console, leader, hz=50)
    bare_sent: dict[int, float] = {}
    time.sleep(0.5)  # a frame that is sent before the hub knows the follower is not a lost one
    publisher.start()
    for number in range(seconds * 50):
        bare_sent[number] = time.time()
        body = {"seq": number, "action": {"n": 0.1}, "t": time.time(), "peer_id": "console", "device": "leader"}
        source = zenoh.SourceInfo(session.id, number)
        session.put("strands/bench/input/leader", json.dumps(body).encode(), source_info=source)
        time.sleep(0.02)
    sent = publisher.stop()["frames"]
    time.sleep(0.2)
    applied, stats = follower.ask()
    mine = percentile([(at - leader.sent[number - 1]) * 1000 for number, at in applied], 0.99)
    raw = percentile([(at - bare_sent[number]) * 1000 for number, at in echo.ask()], 0.99)
    follower.close()
    lost = sent - stats["frames_received"]
    # Where: refused by a guard of the follower, counted by name, or never arrived.
    guards = {why: stats[why] for why in ("out_of_order", "rate_dropped", "slew_rejected", "rejected") if stats[why]}
    where = f": {guards or 'never arrived'}" if lost else ""
    what = f"leader to applied action at 50 Hz for {seconds} s, p99 ({lost} of {sent} lost{where})"
    passed = mine <= 2 * raw + 1 and lost == 0
    return Row(what, f"{mine:.2f} ms", f"{raw:.2f} ms", mine / raw, "at most 2 x + 1 ms, none lost", passed)


def stops(console: Mesh, shared: dict[str, str], state: str, count: int) -> list[Row]:
    """Sixteen robots in four processes; from the call to the last robot's halt."""
    from strands_robots.safety.plane import plane  # noqa: PLC0415 - the console's own lockout is cleared by it

    fleets = [
        Child("fleet", f"arm-{number}", "4", **{**shared, "STRANDS_STATE_DIR": _folder(state, f"fleet-{number}")})
        for number in range(4)
    ]
    eventually(lambda: sum(row["reachable"] for row in console.peers) >= 16, within=20)
    took: list[float] = []
    for _ in range(count):
        started = time.time()
        console.emergency_stop()
        halted = [at for fleet in fleets for at in fleet.ask("halted")]
        took.append((max(halted) - started) * 1000)
        for fleet in fleets:
            fleet.ask("clear")
        plane().clear_local("benchmark")
    rows = [_stop_row("emergency stop to every halt, 16 peers, p99", percentile(took, 0.99), 30)]
    for fleet in fleets:
        fleet.close()
    rows.append(_stop_row("the same, its hub killed 1 s before", _after_hub_loss(state), 2500))
    return rows


def _after_hub_loss(state: str) -> float:
    shared = {"STRANDS_MESH_PORT": str(free_port())}
    hub = MeshPeer("hub", "none", {**shared, "STRANDS_STATE_DIR": _folder(state, "hub")})
    with MeshPeer("caller", "none", {**shared, "STRANDS_STATE_DIR": _folder(state, "caller")}) as caller:
        fleets = [
            Child("fleet", f"lost-{number}", "4", **{**shared, "STRANDS_STATE_DIR": _folder(state, f"lost-{number}")})
            for number in range(4)
        ]
        names = [f"lost-{process}-{number}" for process in range(4) for number in range(4)]
        caller.sees(*names, within=20)
        hub.kill()
        time.sleep(1.0)
        issued, _ = caller.ask("estop")
        halted = [at for fleet in fleets for at in fleet.ask("halted")]
        for fleet in fleets:
            fleet.close()
    return (max(halted) - issued) * 1000 if all(halted) else float("inf")


def losses(state: str) -> list[Row]:
    """Seconds from the death of a process until the others notice it."""
    shared = {"STRANDS_MESH_PORT": str(free_port())}
    with ExitStack() as stack:

        def join(peer_id: str) -> MeshPeer:
            return stack.enter_context(
                MeshPeer(peer_id, "none", {**shared, "STRANDS_STATE_DIR": _folder(state, peer_id)})
            )

        hub = join("first")
        children = [join(f"child-{number}") for number in range(3)]
        for peer in (hub, *children[:2]):
            peer.sees(*(other.peer_id for other in children if other is not peer))
        dead = _killed(children[2])
        eventually(lambda: "child-2" not in hub.ask("reachable"), within=30)
        gone = time.monotonic() - dead
        dead = _killed(hub)
        eventually(lambda: children[0].ask("ping", "child-1", 0.2)["status"] == "ok", within=30)
        again = time.monotonic() - dead
    return [
        _stop_row("a killed peer is out of reach", gone * 1000, 1000),
        _stop_row("the hub is killed, and its children answer one another", again * 1000, 2000),
    ]


def _killed(peer: MeshPeer) -> float:
    at = time.monotonic()
    peer.kill()
    return at


def _stop_row(what: str, took: float, most: float) -> Row:
    return Row(what, f"{took:.1f} ms", "", None, f"at most {most:g} ms", took <= most)


def presence(seconds: int) -> Row:
    """CPU time of a listener to a hundred peers at 2 Hz, beside a bare one that parses the same JSON."""
    with ExitStack() as stack:
        listeners = []
        for role in ("listen", "parse"):
            shared = {"STRANDS_MESH_PORT": str(free_port())}
            listener = Child(role, **shared)
            stack.callback(listener.close)
            listeners.append((listener, shared))
        time.sleep(1)  # their start is no part of it
        for _, shared in listeners:
            stack.callback(Child("crowd", "100", **shared).close)
        for listener, _ in listeners:
            eventually(lambda listener=listener: listener.ask()[1] >= 100, within=10)
        began, before = time.monotonic(), [listener.ask()[0] for listener, _ in listeners]
        time.sleep(seconds)
        after, passed = [listener.ask() for listener, _ in listeners], time.monotonic() - began
    ours, bare = (100 * (now - then) / passed for (now, _), then in zip(after, before, strict=True))
    seen = after[0][1]
    what = f"presence of {seen} peers at 2 Hz, the CPU of one listener, share of a core"
    passes = ours <= 2.5 * bare and seen >= 100
    return Row(what, f"{ours:.2f} %", f"{bare:.2f} %", ours / bare, "at most 2.5", passes)


def idle(shared: dict[str, str], state: str) -> list[Row]:
    bare = subprocess.Popen([sys.executable, "-c", "import sys; print(flush=True); sys.stdin.read()"],
                            stdin=subprocess.PIPE, stdout=subprocess.PIPE)  # fmt: skip
    assert bare.stdout is not None
    bare.stdout.readline()
    empty = psutil.Process(bare.pid).memory_info().rss
    bare.communicate()
    with MeshPeer("idle", "arm", {**shared, "STRANDS_STATE_DIR": _folder(state, "idle")}) as peer:
        time.sleep(2)
        size = (psutil.Process(peer.pid).memory_info().rss - empty) / 2**20
        threads = [name for name in peer.ask("threads") if name != "MainThread"]
    loads = [_import_ms("strands_robots.mesh") - _import_ms("") for _ in range(5)]
    load = statistics.median(loads)
    return [
        Row("memory of an idle peer over the interpreter", f"{size:.0f} MiB", "", None, "at most 60 MiB", size <= 60),
        Row("threads of an idle peer, ours", str(len(threads)), "", None, "at most 6", len(threads) <= 6),
        Row("import strands_robots.mesh over an interpreter", f"{load:.1f} ms", "", None, "at most 20 ms", load <= 20),
    ]


def fleet_idle(state: str, seconds: int) -> Row:
    """CPU of 100 idle robots of a process; threads of the last 90."""
    threads: list[int] = []
    for count in (10, 100):
        shared = {"STRANDS_MESH_PORT": str(free_port()), "STRANDS_STATE_DIR": _folder(state, f"idle-{count}")}
        fleet = Child("fleet", "idle", str(count), **shared)
        time.sleep(3)  # their start is no part of it
        began, (before, _) = time.monotonic(), fleet.ask("cost")
        time.sleep(seconds)
        (after, alive), passed = fleet.ask("cost"), time.monotonic() - began
        fleet.close()
        threads.append(alive)
    each, share = (threads[1] - threads[0]) / 90, 100 * (after - before) / passed
    what = f"100 idle robots of a process, share of a core ({each:.2f} threads for each further one)"
    return Row(what, f"{share:.1f} %", "", None, "at most 10 %, no thread each", each < 0.05 and share <= 10)


def _import_ms(module: str) -> float:
    started = time.perf_counter()
    subprocess.run([sys.executable, "-c", f"import {module}" if module else ""], check=True)
    return (time.perf_counter() - started) * 1000


def _folder(state: str, name: str) -> str:
    path = Path(state) / name
    path.mkdir(mode=0o700, exist_ok=True)
    return str(path)
