"""Attacks of robots on their own stops: foreign ones that lie, and many that lock at once."""

from __future__ import annotations

import contextlib
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from fixtures.lying_robots import ANSWERS, liars
from fixtures.plane_process import planned
from fixtures.stop_controller import controller
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter

from benchmarks.safety import LOST_AFTER_S
from benchmarks.table import Row
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.persistence import LockoutStore

PROCESSES, ROBOTS_EACH = 4, 25
STOPS_A_CLEARING = 50
"""A robot tells 64 stops apart, so its lockouts are cleared before."""


def attacked_link(stack: ExitStack, transport: str, url: str) -> LinkConfig:
    """Return a link to the NATS server at ``url``, or to a new Zenoh router."""
    if transport == "nats":
        return LinkConfig(transport="nats", connect=(url,))
    return LinkConfig(connect=(stack.enter_context(ZenohRouter()).endpoint,), mode="client")


def state_folder(stack: ExitStack) -> Path:
    """Return a state directory of its own."""
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-attacks-")))


def foreign_row(transport: str, url: str, name: str, stops: int) -> Row:
    """Stops of foreign robots that stop nothing, and say so, or the opposite, or nothing."""
    with ExitStack() as stack:
        link, state = attacked_link(stack, transport, url), str(state_folder(stack))
        site = stack.enter_context(liars(link, STRANDS_STATE_DIR=state, STRANDS_HALT_DEADLINE_S="0.1"))
        hand = stack.enter_context(controller(link, environment={"STRANDS_STATE_DIR": state}))
        eventually(lambda: site.ask("up") and hand.ask("up"))
        named = green = 0
        for _ in range(stops):
            report = hand.ask("stop", list(ANSWERS), LOST_AFTER_S)
            named += set(report["not_stopped"]) == set(ANSWERS)
            green += bool(report["stopped"])
            site.ask("clear")
    return Row(
        f"{name}: three foreign robots whose stop does nothing",
        f"{named} of {stops} stops named all three as not stopped, {green} falsely green",
        "",
        None,
        "none missed, none falsely green",
        named == stops and not green,
    )


def files_row(stops: int) -> Row:
    """Stops of four processes with one state directory at once; every lockout is looked for on the disk."""
    names = [[f"arm-{process}-{number}" for number in range(ROBOTS_EACH)] for process in range(PROCESSES)]
    stopped = kept = 0
    with ExitStack() as stack, ThreadPoolExecutor(PROCESSES) as pool:
        state = state_folder(stack)
        children = [
            stack.enter_context(child)
            for child in pool.map(lambda part: planned(part, STRANDS_STATE_DIR=str(state)), names)
        ]

        def on_disk(count: int) -> bool:
            stored = LockoutStore(state).load_all().values()
            return sum(len(each.state.epochs) == count for each in stored) == PROCESSES * ROBOTS_EACH

        for done in range(stops):
            for answers in pool.map(lambda child: child.ask("stop"), children):
                stopped += sum(each is True for each, _ in answers)
            since = done % STOPS_A_CLEARING + 1
            with contextlib.suppress(AssertionError):  # what is not kept by then is counted as missed
                kept += bool(eventually(partial(on_disk, since), LOST_AFTER_S))
            if since == STOPS_A_CLEARING:
                list(pool.map(lambda child: child.ask("clear"), children))
                eventually(partial(on_disk, 0), LOST_AFTER_S)
    robots = PROCESSES * ROBOTS_EACH
    return Row(
        f"{PROCESSES} processes with one state directory stop {robots} robots at once",
        f"{stopped} of {stops * robots} stopped; every lockout on the disk after {kept} of {stops} stops",
        "",
        None,
        "every robot stopped, every lockout kept",
        stopped == stops * robots and kept == stops,
    )
