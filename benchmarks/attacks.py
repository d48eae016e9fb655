"""Attacks: floods, robots that lie, many lockouts, strangers on the mesh, and the attacks of the files beside this."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.mesh_peer import MeshPeer
from fixtures.mesh_strangers import APPROVED, WAVE, stranger_on
from fixtures.nats_server import NatsServer
from fixtures.plane_process import planned
from fixtures.stop_controller import controller
from fixtures.waiting import eventually, free_port

from benchmarks import (
    attacks_approval,
    attacks_audit,
    attacks_doors,
    attacks_doubt,
    attacks_leases,
    attacks_mcp,
    attacks_policies,
    attacks_reachy,
    attacks_sizes,
)
from benchmarks.attacks_robots import attacked_link, files_row, foreign_row, state_folder
from benchmarks.safety import Figures, Fleet, Hiccups, row
from benchmarks.table import Row
from strands_robots.safety import ed25519

STOPS, STOPS_QUICK = 500, 20
FLOOD_S, FLOOD_QUICK_S = 60.0, 10.0
TRIES, TRIES_QUICK = 1000, 20
EVERY_S = 0.5
"""From one true stop to the next in a flood whose memory is watched."""

OTHERS = [f"safety-{number}" for number in range(2, 2002)]
ARMS = ["arm-1", "arm-2"]

PARTS = (
    attacks_doubt,
    attacks_leases,
    attacks_sizes,
    attacks_policies,
    attacks_reachy,
    attacks_approval,
    attacks_mcp,
    attacks_audit,
    attacks_doors,
)


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    stops, seconds = (STOPS_QUICK, FLOOD_QUICK_S) if quick else (STOPS, FLOOD_S)
    rows: list[Row] = []
    with Hiccups() as machine, NatsServer() as server:
        for transport, url, name in (("zenoh", "", "Zenoh"), ("nats", server.url, "NATS")):
            rows.append(_forged(transport, url, f"{name}: forged signatures under 2,000 names", OTHERS, stops, 0.1))
            rows.append(_forged(transport, url, f"{name}: those under the controller's name", ["safety-1"], stops, 0.5))
            rows.append(_flooded(transport, url, name, seconds))
            rows.append(foreign_row(transport, url, name, stops))
        rows.append(files_row(stops))
        rows += _strangers(TRIES_QUICK if quick else TRIES)
        for part in PARTS:
            rows += part.rows(quick)
    return [*rows, machine.row()]


def _strangers(tries: int) -> list[Row]:
    """Tries of strangers to move approved hardware on a mesh of one machine without certificates."""
    rows = []
    with ExitStack() as stack:
        folder = state_folder(stack)
        port = free_port()
        console, arm = (_peer(stack, folder, port, *each) for each in (("console", "none"), ("arm-1", "arm")))
        console.sees("arm-1")
        arm.sees("console")
        stranger = stack.enter_context(stranger_on(port, folder))
        stranger.capture(lambda: console.ask("send", "arm-1", WAVE, 20))
        console.ask("send", "arm-1", {"action": "stop"}, 20)
        for kind in stranger.kinds():
            before, began = len(arm.ask("started")), time.monotonic()
            admitted = stranger.attack(kind, tries)
            moved, took = len(arm.ask("started")) - before, time.monotonic() - began
            text = f"{moved} motions, {len(admitted)} admitted, in {took:.1f} s"
            ok = not moved and not admitted
            rows.append(Row(f"Zenoh mesh: {kind}, {tries} tries to move hardware", text, "", None, "0 motions", ok))
        again = console.ask("send", "arm-1", WAVE, 20)["result"]["status"]
        rows.append(Row("the console afterwards", again, "", None, "it moves the robot", again == "success"))
    return rows


def _peer(stack: ExitStack, folder: Path, port: int, name: str, robot: str) -> MeshPeer:
    state = folder / name
    state.mkdir(mode=0o700)
    settings = {"STRANDS_STATE_DIR": str(state), "STRANDS_MESH_PORT": str(port), **APPROVED}
    peer = MeshPeer(name, robot, settings)
    stack.callback(peer.close)
    return peer


def _forged(transport: str, url: str, what: str, names: Sequence[str], stops: int, bound_s: float) -> Row:
    key = Ed25519PrivateKey.generate()
    settings = {
        "DEVICE_CONNECT_ESTOP_ALLOW": "safety-*",
        "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS": ed25519.encode(ed25519.public_half(key)),
    }
    with Fleet("ours", transport, url, 1, 1, settings, key.private_bytes_raw().hex()) as fleet:
        due = [0.0]

        def arrange() -> None:
            if fleet.forger is not None and time.monotonic() >= due[0]:
                fleet.forger.ask("forge", list(names), 10_000.0, 5.0)
                due[0] = time.monotonic() + 4.9

        figures = fleet.stops(stops, arrange)
    return row(f"{what}, 10,000 a second, beside the signed one", figures, None, bound_s)


def _flooded(transport: str, url: str, name: str, seconds: float) -> Row:
    """True stops, and the memory of the robots' process, in a flood of unsigned stops with fresh ids."""
    with ExitStack() as stack:
        link, state = attacked_link(stack, transport, url), str(state_folder(stack))
        robots = stack.enter_context(planned(ARMS, link, STRANDS_STATE_DIR=state))
        hand, flooder = (stack.enter_context(controller(link, each)) for each in ("safety-1", "flooder"))
        eventually(lambda: hand.ask("stop", ARMS, 5.0)["ok"], 30, "the first stop")
        before = robots.ask("memory_mb")
        flooder.ask("flood", 1, 4000.0, seconds)
        took: list[float | None] = []
        end = time.monotonic() + seconds
        while (began := time.monotonic()) < end:
            report = hand.ask("stop", ARMS, 5.0)
            took.append(report["elapsed_ms"] / 1e3 if report["ok"] else None)
            time.sleep(max(0.0, began + EVERY_S - time.monotonic()))
        sent, after = flooder.ask("flooded"), robots.ask("memory_mb")
    figures = Figures(took)
    return Row(
        f"{name}: {sent / seconds:.0f} stops a second with fresh ids for {seconds:.0f} s: the answers of two robots",
        f"{figures.text()}; memory {before:.0f} to {after:.0f} MB",
        "",
        None,
        "every true stop answered; memory + 20 % at most",
        not figures.lost and after <= 1.2 * before,
    )
