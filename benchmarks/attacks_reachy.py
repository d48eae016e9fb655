"""Attacks on the stop of a Reachy Mini that was never linked: daemons that hang, drip, answer garbage, or are gone."""

from __future__ import annotations

import time

from fixtures.reachy_daemon.broken import FAULTS, BrokenDaemon
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually, free_port

from benchmarks.table import Row
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.safety.stop_executor import stop_executor

EVERY_S = 0.3
LATER_STOP_MS = 40.0


def rows(quick: bool) -> list[Row]:
    """Return the rows of all attacks."""
    return [moving_row(5 if quick else 50), broken_row(1 if quick else 5), hung_row(10 if quick else 200)]


def moving_row(stops: int) -> Row:
    """Stops before the first link, while the daemon runs a move of another client."""
    ended = green = 0
    with Daemon(Kind("1.13.0")) as daemon:
        for _ in range(stops):
            daemon.request("POST", "/api/move/goto", json={"antennas": [1.0, 1.0], "duration": 60.0})
            verdict = ReachyDriver("127.0.0.1", api_port=daemon.port).halt("bench")
            still = daemon.running_moves()
            ended += not still
            green += bool(verdict.stopped and still)
    return Row(
        "Reachy Mini, never linked: its daemon runs a move of another client",
        f"{ended} of {stops} stops ended the move, {green} falsely green",
        "",
        None,
        "every move ended, none falsely green",
        ended == stops and not green,
    )


def broken_row(rounds: int) -> Row:
    """Three stops in a row at each kind of daemon that cannot say what moves."""
    named = stops = 0
    longest_s = 0.0
    for fault in [*FAULTS, "gone"] * rounds:
        with BrokenDaemon(fault if fault != "gone" else FAULTS[0]) as broken:
            reachy = ReachyDriver("127.0.0.1", api_port=broken.port if fault != "gone" else free_port())
            for _ in range(3):
                began = time.monotonic()
                stops += 1
                named += stop_executor().halt(reachy, "head", "bench").stopped is None
                longest_s = max(longest_s, time.monotonic() - began)
    return Row(
        f"Reachy Mini, never linked: its daemon {', '.join(FAULTS)}, or is gone",
        f"{named} of {stops} stops unknown, the slowest after {longest_s:.2f} s",
        "",
        None,
        "all unknown, within the halt deadline of 1 s",
        named == stops and longest_s <= 1.05,
    )


def hung_row(presses: int) -> Row:
    """Presses beside a daemon that hangs: each is sent as soon as the first."""
    took_ms: list[float] = []
    green = 0
    with BrokenDaemon("hangs") as broken:
        reachy = ReachyDriver("127.0.0.1", api_port=broken.port)
        # The first request of a process loads the client.
        reachy.halt("bench")
        stops = []
        for _ in range(presses):
            sent, pressed = len(broken.arrivals), time.monotonic()
            stops.append(stop_executor().submit(reachy, "head", "bench"))
            eventually(lambda sent=sent: len(broken.arrivals) > sent, what="the stop at the daemon")
            took_ms.append((broken.arrivals[sent] - pressed) * 1000)
            time.sleep(max(0.0, pressed + EVERY_S - time.monotonic()))
        green = sum(stop.result(30).stopped is True for stop in stops)
    first, worst = took_ms[0], max(took_ms)
    p99 = sorted(took_ms)[min(len(took_ms) - 1, round(0.99 * len(took_ms)))]
    return Row(
        f"Reachy Mini: {presses} presses {EVERY_S:g} s apart beside a daemon that hangs, press to daemon",
        f"first {first:.1f} ms, p99 {p99:.1f} ms, worst {worst:.1f} ms, {green} falsely green",
        "",
        None,
        f"p99 ≤ {LATER_STOP_MS:g} ms, none falsely green",
        p99 <= LATER_STOP_MS and not green,
    )
