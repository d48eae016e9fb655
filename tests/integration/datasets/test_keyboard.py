"""``dataset record`` at a terminal: the keyboard leads, and other keys say what an attempt was worth."""

from __future__ import annotations

import select
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.terminal import Terminal
from fixtures.waiting import eventually

from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.layout import data_file


@pytest.fixture
def turns(tmp_path: Path) -> Iterator[Terminal]:
    """A recording in which a keyboard may take over from a policy."""
    words = ["--robot", "so100", "--policy", "mock", "--leader", "keyboard", "--task", "wave", "--episodes", "1"]
    made = Terminal("dataset", "record", str(tmp_path / "set"), *words, "--cameras", "none", "--no-network")
    yield made
    made.close()


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    words = ["--robot", "so100", "--leader", "keyboard", "--task", "jog", "--episodes", "2", "--cameras", "none"]
    made = Terminal("dataset", "record", str(tmp_path / "set"), *words, "--no-network")
    yield made
    made.close()


def attempt(terminal: Terminal, folder: Path, keys: str, word: str) -> None:
    """Begin an attempt, lead until it has half a second of steps, and say a word."""
    terminal.shows("Enter begins")
    terminal.press("\n")
    terminal.shows("drops it and ends")
    running = next((folder / ".running").glob("*.mcap"))
    until = time.monotonic() + 30
    while running.stat().st_size < 6_000:
        assert time.monotonic() < until
        terminal.press(keys)
        select.select([], [], [], 0.05)
    terminal.press(word)


def test_keyboard_leads_each_attempt_from_where_the_robot_is(tmp_path: Path, terminal: Terminal) -> None:
    folder = tmp_path / "set"
    attempt(terminal, folder, "q", "x")
    terminal.shows("no success")
    attempt(terminal, folder, "a", "z")
    terminal.shows("Dropped")
    attempt(terminal, folder, "a", "\r")
    terminal.shows("a success")
    assert terminal.child.wait(30) == 0
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (2, [])
    first, second = (tables.read_frames(folder / data_file(number)) for number in (0, 1))
    assert first["observation.state"][-1][0] > first["observation.state"][0][0] + 0.05
    assert second["observation.state"][-1][0] < second["observation.state"][0][0] - 0.05
    assert abs(second["action"][0][0] - second["observation.state"][0][0]) < 0.2, "no jump to where it was led before"
    assert (first["next.success"].any(), second["next.success"][-1]) == (False, True)
    assert first["intervention"].all()
    assert second["intervention"].all()


def test_keyboard_takes_over_from_a_policy_and_gives_back(tmp_path: Path, turns: Terminal) -> None:
    folder = tmp_path / "set"
    turns.shows("Enter begins")
    turns.press("\n")
    turns.shows("v takes over and gives back")
    turns.shows("The policy drives.")
    grown(folder, 8_000)
    turns.press_until("qq", "The leader leads.")
    grown(folder, 16_000)
    turns.press_until("v", "The policy drives.")
    grown(folder, 24_000)
    turns.press("\n")
    turns.shows("a success")
    assert turns.child.wait(30) == 0
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (1, [])
    frames = tables.read_frames(folder / data_file(0))
    led = [bool(each) for each in frames["intervention"]]
    assert [each for each, before in zip(led, [not led[0], *led], strict=False) if each != before] == [
        False,
        True,
        False,
    ]
    steps = abs(frames["action"][1:, 0] - frames["action"][:-1, 0])
    assert steps.max() < 0.3, "no jump at a seam"
    assert frames["next.success"][-1]


def grown(folder: Path, size: int) -> None:
    """Wait until the running attempt has so many bytes."""
    eventually(lambda: next((folder / ".running").glob("*.mcap")).stat().st_size > size, within=30)
