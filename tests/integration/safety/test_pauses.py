"""Processes that are frozen by SIGSTOP while their robots move: nothing is written before the hold."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fixtures.paused_motions import PausedMotions
from fixtures.roster_robots import RosterRobots
from fixtures.waiting import eventually, free_port

from strands_robots.safety.process import HOLD_S, PAUSE_S

ROUNDS = 5
IN_FLIGHT = 1
"""A write that the process was stopped in may end when it goes on."""

Writes = Callable[[float], list[float]]


def frozen_again_and_again(child: RosterRobots | PausedMotions, written: Writes) -> None:
    """Freeze and continue the process, and look for writes before the end of the hold."""
    for _ in range(ROUNDS):
        since = time.monotonic()
        eventually(lambda since=since: len(written(since)) > 5, what="the robot moves")
        child.signal(signal.SIGSTOP)
        time.sleep(PAUSE_S + 0.2)
        woken = time.monotonic()
        child.signal(signal.SIGCONT)
        # It goes on by itself where no stop was missed, and does not make up for what it missed.
        eventually(lambda woken=woken: len(written(woken + HOLD_S)) > 5, what="the motion goes on")
        early = [each - woken for each in written(woken) if each - woken < HOLD_S]
        assert len(early) <= IN_FLIGHT, early


def test_arm_writes_nothing_between_sigcont_and_the_end_of_the_hold(tmp_path: Path) -> None:
    settings = {"STRANDS_MESH_PORT": str(free_port()), "STRANDS_MESH": "true"}
    child = RosterRobots(None, tmp_path, ["arm-1"], settings, hz=200.0)
    try:
        child.ask("move")
        frozen_again_and_again(child, lambda since: child.writes("arm-1", since))
    finally:
        child.close()


@pytest.fixture(params=["world", "base"])
def motions(request: pytest.FixtureRequest) -> Iterator[PausedMotions]:
    child = PausedMotions(request.param)
    yield child
    child.close()


def test_simulated_arm_and_base_write_nothing_between_sigcont_and_the_end_of_the_hold(motions: PausedMotions) -> None:
    motions.ask("move")
    frozen_again_and_again(motions, motions.written)


def test_short_pause_holds_nothing(motions: PausedMotions) -> None:
    motions.ask("move")
    since = time.monotonic()
    eventually(lambda: len(motions.written(since)) > 5, what="the robot moves")
    motions.signal(signal.SIGSTOP)
    motions.signal(signal.SIGCONT)
    woken = time.monotonic()
    eventually(lambda: motions.written(woken), what="the motion goes on")
