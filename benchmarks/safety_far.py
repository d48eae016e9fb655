"""A stop over a bad link: 200 ms each way and one frame in ten lost, between two network namespaces."""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.network_lab import NetworkLab, Weather, missing
from fixtures.stop_controller import controller
from fixtures.stop_robots import robots
from fixtures.waiting import eventually

from benchmarks.table import Row
from strands_robots.device_connect.backends import LinkConfig

DELAY_S, LOSS = 0.2, 0.1
RETRANSMISSION_S = 2 * DELAY_S + 0.2
"""TCP's patience at this round trip: the round trip and its least variance of 200 ms (RFC 6298, Linux's minimum)."""

PORT = 7447


def far_rows(stops: int) -> list[Row]:
    """One row a transport, measured side by side."""
    if why := missing():
        return [Row("200 ms delay and 10 % loss", f"not measured: {why}", "", None, "", ok=True)]
    found: dict[str, list[float | None]] = {}

    def measure(name: str, run: Callable[[int], list[float | None]]) -> None:
        found[name] = run(stops)

    threads = [
        threading.Thread(target=measure, args=(name, run)) for name, run in (("Zenoh peers", _zenoh), ("NATS", _nats))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [_row(name, took) for name, took in found.items()]


def _row(name: str, took: list[float | None]) -> Row:
    came = sorted(each for each in took if each is not None)
    bound = DELAY_S + 3 * RETRANSMISSION_S
    p99 = came[int(0.99 * len(came))]
    return Row(
        f"{name}: 200 ms delay and 10 % loss on the link",
        f"p50 {statistics.median(came) * 1e3:.0f} p99 {p99 * 1e3:.0f} max {came[-1] * 1e3:.0f} ms of {len(took)}, "
        f"{len(took) - len(came)} lost",
        "",
        None,
        f"p99 ≤ {bound * 1e3:.0f} ms: one way and three retransmissions; none lost",
        p99 <= bound and len(came) == len(took),
    )


def _zenoh(stops: int) -> list[float | None]:
    with NetworkLab() as lab:
        here = f"tcp/{lab.here.address}:{PORT}"
        near = LinkConfig(mode="peer", listen=(here,), multicast=False)
        return _measured(lab, near, LinkConfig(mode="peer", connect=(here,), multicast=False), stops)


def _nats(stops: int) -> list[float | None]:
    with NetworkLab() as lab, NatsServer(host=lab.here.address, within=lab.here.within) as server:
        link = LinkConfig(transport="nats", connect=(server.url,))
        return _measured(lab, link, link, stops)


def _measured(lab: NetworkLab, near: LinkConfig, far: LinkConfig, stops: int) -> list[float | None]:
    with ExitStack() as stack:
        state = stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-far-"))
        Path(state).chmod(0o700)
        environment = {"STRANDS_STATE_DIR": state}
        site = stack.enter_context(robots(near, "r-0", hz=500.0, environment=environment, within=lab.here.within))
        hand = stack.enter_context(controller(far, environment=environment, within=lab.there.within))
        eventually(lambda: hand.ask("stop", ["r-0"], 1.0)["ok"], 20, "the first stop")
        site.ask("clear")
        lab.weather = Weather(delay_s=DELAY_S, loss=LOSS)
        return [_one(site, hand) for _ in range(stops)]


def _one(site: Child, hand: Child) -> float | None:
    site.ask("move")
    report = hand.ask("stop", ["r-0"], 20.0)
    still = site.ask("facts")["r-0"]["still"]
    time.sleep(0.01)
    site.ask("clear")
    return still - report["at"] if report["ok"] and still > report["at"] else None
