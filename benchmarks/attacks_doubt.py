"""Presses behind a doubt: robots of a stranger that stop at once and are read with trouble."""

from __future__ import annotations

import time
from contextlib import ExitStack

from fixtures.doubted_robots import DOUBTS, doubted
from fixtures.stop_controller import controller
from fixtures.waiting import eventually

from benchmarks.attacks_robots import attacked_link, state_folder
from benchmarks.table import Row

PRESSES, PRESSES_QUICK = 1000, 40
EVERY_S = 0.3
HANG_S = 2.0
CLEARED_EVERY = 50
"""A robot tells 64 stops apart, so its lockouts are cleared before."""

TROUBLES = {
    "status": "status hangs for 2 s",
    "running": "status says running",
    "repr": "answer's text hangs for 2 s",
    "get": "answer's fields hang for 2 s each",
    "exception": "exception's text hangs for 2 s",
}

P99_MS, WORST_MS = 5.0, 20.0


def rows(quick: bool) -> list[Row]:
    """One robot at a time, over Zenoh, the machine otherwise idle."""
    return [_row(doubt, PRESSES_QUICK if quick else PRESSES) for doubt in DOUBTS]


def _row(doubt: str, presses: int) -> Row:
    with ExitStack() as stack:
        link, state = attacked_link(stack, "zenoh", ""), str(state_folder(stack))
        site = stack.enter_context(doubted(link, HANG_S, [doubt], STRANDS_STATE_DIR=state))
        hand = stack.enter_context(controller(link, environment={"STRANDS_STATE_DIR": state}))
        eventually(lambda: site.ask("up") and hand.ask("up"))
        pressed: list[float] = []
        for number in range(presses):
            if number % CLEARED_EVERY == CLEARED_EVERY - 1:
                site.ask("clear")
            pressed.append(hand.ask("begin", [doubt], 0.2))
            time.sleep(EVERY_S)
        halts = site.ask("stops", doubt)
    took = sorted(_first_after(at, halts) for at in pressed)
    p50, p99, worst = took[len(took) // 2], took[int(0.99 * (len(took) - 1))], took[-1]
    return Row(
        f"{presses} presses of a robot of one's own whose {TROUBLES[doubt]}, from press to halt",
        f"p50 {p50:.1f} p99 {p99:.1f} worst {worst:.1f} ms",
        "",
        None,
        f"p99 ≤ {P99_MS:g} ms, worst ≤ {WORST_MS:g} ms",
        p99 <= P99_MS and worst <= WORST_MS,
    )


def _first_after(at: float, halts: list[float]) -> float:
    """Return the milliseconds from a press to the first halt after it."""
    return min((each - at for each in halts if each >= at), default=float("inf")) * 1000
