"""Attacks by policy servers: answers that would take a robot's interpreter or its memory."""

from __future__ import annotations

import time
from contextlib import ExitStack

from fixtures.costs import MEMORY_MAX, TIME_MAX_S, cost, policy_decoders
from fixtures.hostile_policy_server import hostile
from fixtures.policy_site import policy_site

from benchmarks.attacks_robots import state_folder
from benchmarks.safety import Figures
from benchmarks.table import Row

STOPS, STOPS_QUICK = 500, 30
INPUTS, INPUTS_QUICK = 10_000, 500
MOVING_S = 0.25
"""Time in which both robots move before each stop."""

STOP_MAX_MS, MEMORY_MAX_MB = 40.0, 100.0
KINDS = ("openpi", "remote", "remote msgpack", "groot")


def rows(quick: bool) -> list[Row]:
    """Measure and give the rows of the table."""
    stops, inputs = (STOPS_QUICK, INPUTS_QUICK) if quick else (STOPS, INPUTS)
    return [_bombed("", stops), *(_bombed(kind, stops) for kind in KINDS), *_fuzzed(inputs)]


def _bombed(kind: str, stops: int) -> Row:
    """Stops of two robots, one of them moved by a hostile server; without a kind the server is not asked."""
    with ExitStack() as stack:
        server = stack.enter_context(hostile(kind or "openpi"))
        state = str(state_folder(stack))
        site = stack.enter_context(
            policy_site(["arm-1"], kind or "openpi", server.ask("port"), STRANDS_STATE_DIR=state)
        )
        before = site.ask("peak_mb")
        if kind:
            site.ask("attack")
        stills, verdicts = [], []
        for _ in range(stops):
            site.ask("clear")
            site.ask("move")
            time.sleep(MOVING_S)
            still, _, verdict = site.ask("press", time.monotonic())
            stills.append(still / 1e3)
            verdicts.append(verdict / 1e3)
        sent, grown = sum(server.ask("sent").values()), site.ask("peak_mb") - before
    still_of, verdict_of = Figures(stills), Figures(verdicts)
    what = f"a hostile {kind} server, {sent} bombs of 24 and 1 MB" if kind else "the same two robots without an attack"
    return Row(
        f"{what}: the last write of two robots",
        f"{still_of.text()}; verdicts p99 {verdict_of.quantile(0.99) * 1e3:.0f} ms; memory + {grown:.0f} MB at most",
        "",
        None,
        f"p99 ≤ {STOP_MAX_MS:.0f} ms, memory + ≤ {MEMORY_MAX_MB:.0f} MB",
        still_of.quantile(0.99) * 1e3 <= STOP_MAX_MS and grown <= MEMORY_MAX_MB,
    )


def _fuzzed(inputs: int) -> list[Row]:
    """Worst cost of each decoder over hostile inputs of up to 16 MB."""
    found = {name: cost(decoder, inputs) for name, decoder in policy_decoders().items()}
    return [
        Row(
            f"the decoder of {name}: {each.inputs:,} hostile inputs of up to 16 MB",
            f"{each.seconds * 1e3:.1f} ms, {each.memory / 2**20:.1f} MB at worst",
            "",
            None,
            f"≤ {TIME_MAX_S * 1e3:.0f} ms of the thread, ≤ {MEMORY_MAX / 2**20:.0f} MB beyond the input",
            each.within,
        )
        for name, each in found.items()
    ]
