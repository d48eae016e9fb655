from __future__ import annotations

import io
import threading
import time
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import pytest
from fixtures.waiting import eventually
from rich.console import Console

from strands_robots.cli import safety_controller
from strands_robots.cli.safety_controller import FleetScreen
from strands_robots.cli.stop_report import style_of
from strands_robots.device_connect.backends import loopback_config
from strands_robots.fleet import stop_button, watched_robots
from strands_robots.fleet.lockout_report import LockoutReport
from strands_robots.fleet.stop_button import StopButton
from strands_robots.safety.answers import Answer
from strands_robots.safety.controller import Progress, StopReport
from strands_robots.safety.lockout import Lockout


class FakeController:
    """Records each stop and answers when the test allows it."""

    controller_id = "safety-1"
    link_up = True
    network = None

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.presses: list[str] = []
        self.expected: list[Collection[str]] = []
        self.answer = threading.Event()
        self.answer.set()
        self.links: list[bool] = []
        self.refused: dict[str, Answer] = {}
        self.silent: list[tuple[str, ...]] = []
        self.stopped: dict[str, Answer] = {}
        self.late: dict[str, Answer] = {}

    def press(self, estop_id: str) -> None:
        self.presses.append(estop_id)

    def stop(self, expected: Collection[str], reason: str, *, estop_id: str, on_progress: Any) -> StopReport:
        self.ids.append(estop_id)
        self.expected.append(expected)
        assert self.answer.wait(60.0)
        link = self.links.pop(0) if self.links else True
        on_progress(Progress(estop_id, self.stopped, (), link, 1.0))
        silent = self.silent.pop(0) if self.silent else ()
        return StopReport(estop_id, self.stopped, {}, self.refused, silent, link, 1.0)

    def review(self, report: StopReport) -> StopReport:
        return replace(report, stopped={}, not_stopped=self.late) if self.late else report


@pytest.fixture
def controller() -> FakeController:
    return FakeController()


def made(controller: FakeController) -> StopButton:
    return StopButton(controller, lambda: ("arm-1",), "test")  # type: ignore[arg-type]


def test_press_stops_the_robots_known_at_that_moment(controller: FakeController) -> None:
    button = made(controller)
    button.press()
    eventually(lambda: button.report is not None and not button.running)
    assert controller.expected == [("arm-1",)]


def test_key_held_down_is_one_stop(controller: FakeController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_button, "KEY_REPEAT_S", 60.0)
    button = made(controller)
    controller.answer.clear()
    for _ in range(50):
        button.press()
    controller.answer.set()
    eventually(lambda: button.report is not None)
    button.press()
    eventually(lambda: not button.running)
    assert len(set(controller.ids)) == 1
    assert len(controller.ids) <= 2


def test_later_press_is_a_stop_of_its_own(controller: FakeController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_button, "KEY_REPEAT_S", 0.0)
    button = made(controller)
    controller.answer.clear()
    button.press()
    button.press()
    eventually(lambda: len(set(controller.ids)) == 2)
    controller.answer.set()
    eventually(lambda: not button.running)


def test_robot_resumed_meanwhile_is_stopped_with_a_new_id(controller: FakeController) -> None:
    button = made(controller)
    controller.refused = {"arm-1": Answer("arm-1", None, 1.0, "this stop was resumed before it came again")}
    for presses in (1, 2):
        button.press()
        eventually(lambda: not button.running)
        assert len(set(controller.ids)) == presses


def test_stop_that_never_left_is_repeated_with_its_id(controller: FakeController) -> None:
    controller.links = [False, False, True]
    button = made(controller)
    button.press()
    eventually(lambda: button.report is not None and not button.running)
    assert len(controller.ids) == 3
    assert len(set(controller.ids)) == 1
    assert controller.presses == controller.ids[:1]


def test_stop_is_repeated_until_no_robot_is_silent(controller: FakeController) -> None:
    controller.silent = [("arm-1",), ("arm-1",), ()]
    button = made(controller)
    button.press()
    eventually(lambda: not button.running)
    assert len(controller.ids) == 3
    assert len(set(controller.ids)) == 1
    assert button.report is not None
    assert button.report.silent == ()


def test_screen_says_how_long_ago_a_stop_was_pressed(controller: FakeController) -> None:
    fleet, button = FleetScreen(controller, loopback_config(), None), made(controller)  # type: ignore[arg-type]
    fleet.update([LockoutReport("arm-1")])
    button.progress = Progress("e" * 32, {}, ("arm-1",), False, 6600.0)
    controller.answer.clear()
    button.press()
    assert "STOPPING, pressed 6.6 s ago: 0 answered" in drawn(fleet, button)
    controller.answer.set()
    eventually(lambda: not button.running)
    button.progress = Progress("e" * 32, {"arm-1": Answer("arm-1", True, 11_021.0, "")}, (), True, 11_021.0, 11_000.0)
    assert "stopped 11.0 s after the press" in drawn(fleet, button)


def test_screen_turns_red_when_a_robot_says_later_that_it_did_not_stop(controller: FakeController) -> None:
    fleet, button = FleetScreen(controller, loopback_config(), None), made(controller)  # type: ignore[arg-type]
    fleet.update([LockoutReport("arm-1")])
    controller.stopped = {"arm-1": Answer("arm-1", True, 8.0, "")}
    button.press()
    eventually(lambda: button.report is not None and not button.running)
    button.review()
    assert "stopped in 8.0 ms" in drawn(fleet, button)
    controller.late = {"arm-1": Answer("arm-1", False, 4000.0, "arm-1: it moved")}
    button.review()
    assert button.report is not None
    assert style_of(button.report) == "bold red"
    assert "1 DID NOT STOP" in drawn(fleet, button)
    assert "stopped in 8.0 ms" not in drawn(fleet, button)


def drawn(fleet: FleetScreen, button: StopButton) -> str:
    out = Console(file=io.StringIO(), width=160, height=40)
    out.print(fleet.draw(button, ["ERROR something"]))
    output: str = out.file.getvalue()  # type: ignore[attr-defined]  # it is a StringIO
    return output


def test_screen_shows_lockouts_check_ins_and_gone_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    fake: Any = FakeController()
    fleet, button = FleetScreen(fake, loopback_config(), 0.5), StopButton(fake, lambda: (), "")
    hold = Lockout("e" * 32, "desk-1", "a hand", 0.0)
    checked = {"check_in": {"required": True, "timeout_s": 2.0, "time_left_s": 1.25}}
    fleet.update(
        [
            LockoutReport("arm-1", (hold,)),
            LockoutReport("arm-2", facts=checked),
            LockoutReport("arm-9", problem="no answer"),
        ]
    )
    output = drawn(fleet, button)
    assert "LOCKED" in output and "desk-1 a hand" in output
    assert "1.2 s left" in output
    assert "arm-9" not in output
    assert "SPACE stops everything" in output and "ERROR something" in output
    monkeypatch.setattr(safety_controller, "GONE_S", 0.0)
    monkeypatch.setattr(watched_robots, "GONE_S", 0.0)
    fleet.update([LockoutReport("arm-1", problem="no answer")])
    assert "GONE" in drawn(fleet, button)
    assert set(fleet.expected()) == {"arm-1", "arm-2"}
    fleet.forget()
    assert fleet.expected() == ()


def test_robots_that_beat_are_asked_in_turn_and_all_others_at_each_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_robots, "ASKED_MOST", 3)
    fake: Any = FakeController()
    fleet, now = FleetScreen(fake, loopback_config(), None), time.monotonic()
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


def calm_fleet(monkeypatch: pytest.MonkeyPatch, robots: int) -> tuple[FleetScreen, Turning, list[str]]:
    """Return a screen of robots that have answered, beat, and are asked three at a look."""
    clock, fake = Turning(), FakeController()
    monkeypatch.setattr(safety_controller, "time", clock)
    monkeypatch.setattr(watched_robots, "time", clock)
    monkeypatch.setattr(watched_robots, "ASKED_MOST", 3)
    names = [f"arm-{number}" for number in range(robots)]
    fleet = FleetScreen(fake, loopback_config(), None)  # type: ignore[arg-type]
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
    clock.now += safety_controller.GONE_S + 1.0
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


def test_age_of_a_lockouts_report_is_shown_beside_a_fresh_beat(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, clock, _ = calm_fleet(monkeypatch, 1)
    fake: Any = FakeController()
    button = StopButton(fake, lambda: (), "")
    assert "s ago" not in drawn(fleet, button).replace("0 s ago", "")
    clock.now += 7.0
    fleet.take_beats({"arm-0": clock.now})
    assert "free, 7 s ago" in drawn(fleet, button)
    assert "NO ANSWER" not in drawn(fleet, button)
    fleet.update([LockoutReport("arm-0", problem="no answer")])
    assert "beats, NO ANSWER for 7 s" in drawn(fleet, button)
    fleet.update([LockoutReport("arm-0", at=clock.now)])
    assert "NO ANSWER" not in drawn(fleet, button)


def test_a_robot_that_beats_is_not_gone_though_its_status_is_old() -> None:
    fake: Any = FakeController()
    fleet, button = FleetScreen(fake, loopback_config(), None), StopButton(fake, lambda: (), "")
    fleet.update([LockoutReport("arm-1", at=time.monotonic() - 100.0)])
    assert "GONE" in drawn(fleet, button)
    fleet.take_beats({"arm-1": time.monotonic() + 1000.0})
    assert "GONE" not in drawn(fleet, button)
    fleet.forget()
    assert fleet.expected() == ("arm-1",)
