"""Robots that a console watches: which of them are asked at a look, and what they last reported."""

from __future__ import annotations

import time

import pytest
from fixtures.waiting import eventually
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.fleet import safety_console
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.fleet.safety_console import WatchedRobots
from strands_robots.safety.lockout import Lockout
from strands_robots.safety.scope import Scope


def test_robots_that_beat_are_asked_in_turn_and_all_others_at_each_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety_console, "ASKED_MOST", 3)
    fleet, now = WatchedRobots(), time.monotonic()
    names = [f"arm-{number}" for number in range(10)]
    assert fleet.due(names) == names
    fleet.update([LockoutReport(name, at=now - 100.0 + number) for number, name in enumerate(names)])
    assert fleet.due(names) == names
    fleet.take_beats(dict.fromkeys(names[:8], now + 1000.0))
    assert fleet.due([*names, "new"]) == ["arm-0", "arm-1", "arm-2", "arm-8", "arm-9", "new"]
    assert set(fleet.expected()) == set(names)
    assert fleet.due(names) == names, "after a stop each is asked"


class Turning:
    """A monotonic clock that the test turns."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        """Return its seconds."""
        return self.now


def calm_fleet(monkeypatch: pytest.MonkeyPatch, robots: int) -> tuple[WatchedRobots, Turning, list[str]]:
    """Return robots that have answered, beat, and are asked three at a look."""
    clock = Turning()
    monkeypatch.setattr(safety_console, "time", clock)
    monkeypatch.setattr(safety_console, "ASKED_MOST", 3)
    names = [f"arm-{number}" for number in range(robots)]
    fleet = WatchedRobots()
    fleet.take_beats(dict.fromkeys(names, 1e9))
    assert fleet.due(names) == names
    fleet.update([LockoutReport(name, at=clock.now) for name in names])
    return fleet, clock, names


def test_robots_that_beat_and_do_not_answer_take_no_turn_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, clock, names = calm_fleet(monkeypatch, 9)
    asked: list[str] = []
    for _look in range(6):
        clock.now += 1.0
        due = fleet.due(names)
        asked += due
        answers = [LockoutReport(name, at=clock.now) for name in due if name not in names[:3]]
        fleet.update(answers + [LockoutReport(name, problem="no answer") for name in due if name in names[:3]])
    assert sorted(asked) == sorted(names * 2), "each is asked once in three looks"


def test_silent_robots_without_a_beat_are_asked_in_turn_and_after_all_others(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, clock, names = calm_fleet(monkeypatch, 2)
    fleet.take_beats({})
    silent = [f"a-silent-{number}" for number in range(9)]
    every, asked = [*names, *silent], list[str]()
    assert set(fleet.due(every)) == set(every), "one that is new is asked at once"
    for _look in range(3):
        fleet.update([LockoutReport(name, at=clock.now) for name in names])
        fleet.update([LockoutReport(name, problem="no answer") for name in silent])
        clock.now += 1.0
        due = fleet.due(every)
        assert due[:2] == names
        asked += due[2:]
    assert sorted(asked) == silent, "three at a look, each of them once"


def test_robots_that_do_not_answer_a_stop_take_their_turn_again_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, clock, names = calm_fleet(monkeypatch, 9)
    fleet.expected()
    clock.now += safety_console.GONE_S + 1.0
    assert fleet.due(names) == names
    clock.now += 1.0
    assert len(fleet.due(names)) == 3


@pytest.mark.parametrize("lockouts", [(Lockout("e" * 32, "desk-1", "a hand", 0.0),), ()])
def test_all_robots_are_asked_after_one_was_stopped_or_resumed_by_another(
    lockouts: tuple[Lockout, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet, clock, names = calm_fleet(monkeypatch, 9)
    before = () if lockouts else (Lockout("e" * 32, "desk-1", "a hand", 0.0),)
    fleet.update([LockoutReport("arm-4", before, at=clock.now)])
    clock.now += 60.0
    fleet.due(names)
    clock.now += 1.0
    assert len(fleet.due(names)) == 3
    fleet.update([LockoutReport("arm-4", lockouts, at=clock.now)])
    clock.now += 1.0
    assert fleet.due(names) == names


def test_poll_goes_on_after_the_network_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety_console, "LOOK_S", 0.01)
    network, fleet = ScriptedNetwork(), WatchedRobots()
    network.unreachable = "cable"
    fleet.poll(network)
    eventually(lambda: "cannot be polled: cable" in fleet.problem)
    network.unreachable = ""
    eventually(lambda: list(fleet.reports) == ["arm-1"] and not fleet.problem)
    fleet.close()


def test_a_stop_of_some_robots_is_for_those_that_were_seen() -> None:
    fleet = WatchedRobots()
    fleet.update([LockoutReport("arm-1", facts={"cell": "cell-1"})])
    assert fleet.has(Scope.named(["arm-1", "arm-9"])) and fleet.has(Scope(cell="cell-1"))
    assert not fleet.has(Scope.named(["arm-9"])) and not fleet.has(Scope(cell="cell-2"))
    fleet.update([LockoutReport("nowhere", facts={"cell": ""})])
    assert fleet.has(Scope(cell="cell-2")), "a robot without a cell stops with each"
