"""Attacks by size: stops of 8 MB from a stranger, beside the true ones."""

from __future__ import annotations

import time
from contextlib import ExitStack

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.decoders import MEMORY_MAX, TIME_MAX_S, worst_of
from fixtures.nats_server import NatsServer

from benchmarks.safety import Figures, Fleet
from benchmarks.table import Row

STOPS, STOPS_QUICK = 500, 60
INPUTS, INPUTS_QUICK = 10_000, 1000
BULK, BULK_HZ, BULK_S = 8 * 2**20, 5.0, 5.0
BOUND_S, MEMORY_MB = 0.04, 100.0


def rows(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    stops = STOPS_QUICK if quick else STOPS
    with NatsServer(max_payload=2 * BULK) as server:
        bulks = [_bulk("zenoh", "", "Zenoh D2D", stops), _bulk("nats", server.url, "NATS", stops)]
    return [*bulks, _fuzz(INPUTS_QUICK if quick else INPUTS)]


def _fuzz(count: int) -> Row:
    """Hostile messages at every decoder of the package."""
    worst, over, done = worst_of(count)
    slowest = max(worst, key=lambda name: worst[name].seconds)
    largest = max(worst, key=lambda name: worst[name].memory)
    seconds, memory = worst[slowest].seconds * 1e3, worst[largest].memory / 1e6
    return Row(
        f"{count:,} hostile messages of up to 16 MB, {done:,} decodings by {len(worst)} decoders",
        f"at most {seconds:.1f} ms ({slowest}) and {memory:.1f} MB ({largest})",
        "",
        None,
        f"{TIME_MAX_S * 1e3:.0f} ms and {MEMORY_MAX / 1e6:.0f} MB at most",
        not over,
    )


def _bulk(transport: str, url: str, name: str, stops: int) -> Row:
    """True stops and memory while a stranger publishes stops of 8 MB of empty lists."""
    # With a key there is a second controller process; no robot asks for a signature.
    seed = Ed25519PrivateKey.generate().private_bytes_raw().hex()
    settings = {"DEVICE_CONNECT_ESTOP_ALLOW": "safety-*"}
    with ExitStack() as stack:
        fleet = stack.enter_context(Fleet("ours", transport, url, 1, 1, settings, seed))
        site, stranger = fleet.sites[0], fleet.forger
        assert stranger is not None
        before, due, most = site.ask("memory_mb"), 0.0, 0.0
        took: list[float | None] = []
        for _ in range(stops):
            if time.monotonic() >= due:
                stranger.ask("bulk", "stranger", BULK, BULK_HZ, BULK_S)
                due = time.monotonic() + BULK_S - 0.1
            took.append(fleet.stop_once())
            most = max(most, site.ask("memory_mb"))
        sent = stranger.ask("flooded")
    figures, more = Figures(took), most - before
    return Row(
        f"{name}: a stranger's stops of 8 MB, {BULK_HZ:g} a second ({sent} sent), beside true ones",
        f"{figures.text()}; memory + {more:.0f} MB",
        "",
        None,
        f"p99 ≤ {BOUND_S * 1e3:.0f} ms; memory + {MEMORY_MB:.0f} MB at most",
        figures.quantile(0.99) <= BOUND_S and not figures.lost and more <= MEMORY_MB and sent > 0,
    )
