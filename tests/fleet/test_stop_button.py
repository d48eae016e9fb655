"""Stop buttons: one stop at each press, on every network of a console under one id."""

from __future__ import annotations

import pytest
from fixtures.waiting import eventually
from tests.fleet.scripted_sender import ScriptedSender

from strands_robots.fleet import safety_console
from strands_robots.fleet.safety_console import StopButton, StopButtons
from strands_robots.safety.answers import Answer
from strands_robots.safety.scope import EVERY_ROBOT, Scope


@pytest.fixture
def controller() -> ScriptedSender:
    return ScriptedSender()


def made(controller: ScriptedSender) -> StopButton:
    return StopButton(controller, lambda: ("arm-1",), "test")  # type: ignore[arg-type]


def test_press_stops_the_robots_known_at_that_moment(controller: ScriptedSender) -> None:
    button = made(controller)
    button.press()
    eventually(lambda: button.report is not None and not button.running)
    assert controller.expected == [("arm-1",)]


def test_key_held_down_is_one_stop(controller: ScriptedSender, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety_console, "KEY_REPEAT_S", 60.0)
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


def test_later_press_is_a_stop_of_its_own(controller: ScriptedSender, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety_console, "KEY_REPEAT_S", 0.0)
    button = made(controller)
    controller.answer.clear()
    button.press()
    button.press()
    eventually(lambda: len(set(controller.ids)) == 2)
    controller.answer.set()
    eventually(lambda: not button.running)


def test_robot_resumed_meanwhile_is_stopped_with_a_new_id(controller: ScriptedSender) -> None:
    button = made(controller)
    controller.refused = {"arm-1": Answer("arm-1", None, 1.0, "this stop was resumed before it came again")}
    for presses in (1, 2):
        button.press()
        eventually(lambda: not button.running)
        assert len(set(controller.ids)) == presses


def test_stop_that_never_left_is_repeated_with_its_id(controller: ScriptedSender) -> None:
    controller.links = [False, False, True]
    button = made(controller)
    button.press()
    eventually(lambda: button.report is not None and not button.running)
    assert len(controller.ids) == 3
    assert len(set(controller.ids)) == 1
    assert controller.presses == controller.ids[:1]


def test_stop_is_repeated_until_no_robot_is_silent(controller: ScriptedSender) -> None:
    controller.silent = [("arm-1",), ("arm-1",), ()]
    button = made(controller)
    button.press()
    eventually(lambda: not button.running)
    assert len(controller.ids) == 3
    assert len(set(controller.ids)) == 1
    assert button.report is not None
    assert button.report.silent == ()


class TestEveryNetwork:
    """A console with a button on each network."""

    @pytest.fixture
    def far(self) -> ScriptedSender:
        return ScriptedSender()

    @pytest.fixture
    def buttons(self, controller: ScriptedSender) -> StopButtons:
        buttons = StopButtons("test")
        buttons.add("near", controller, lambda scope: scope.only or ("arm-1",))  # type: ignore[arg-type]
        return buttons

    def test_one_press_has_one_id_on_every_network(
        self, buttons: StopButtons, controller: ScriptedSender, far: ScriptedSender
    ) -> None:
        buttons.add("far", far, lambda scope: ("arm-2",))  # type: ignore[arg-type]
        buttons.press()
        eventually(lambda: not buttons.running)
        assert controller.ids == far.ids == controller.presses == far.presses
        assert (controller.expected, far.expected) == ([("arm-1",)], [("arm-2",)])

    def test_network_that_hangs_keeps_no_press_from_the_other(
        self, buttons: StopButtons, controller: ScriptedSender, far: ScriptedSender
    ) -> None:
        controller.answer.clear()
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        buttons.press()
        eventually(lambda: far.ids == controller.ids and len(far.ids) == 1)
        assert buttons.running
        controller.answer.set()
        eventually(lambda: not buttons.running)

    @pytest.mark.parametrize("seconds", [0.0, 9.0])
    def test_press_leaves_on_a_network_that_is_added_within_ten_seconds(
        self, buttons: StopButtons, far: ScriptedSender, controller: ScriptedSender, seconds: float, clock: Turned
    ) -> None:
        buttons.press()
        eventually(lambda: not buttons.running)
        clock.now += seconds
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        eventually(lambda: far.ids == controller.ids)

    def test_press_before_any_network_is_there_leaves_on_the_first(self, far: ScriptedSender) -> None:
        buttons = StopButtons("test")
        buttons.press()
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        eventually(lambda: len(far.ids) == 1)
        assert far.scopes == [EVERY_ROBOT]

    def test_press_of_long_ago_does_not_leave_on_a_network_that_is_added(
        self, buttons: StopButtons, far: ScriptedSender, clock: Turned
    ) -> None:
        buttons.press()
        eventually(lambda: not buttons.running)
        clock.now += safety_console.LATE_S + 0.1
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        buttons.press(Scope.named(["arm-1"]), ["near"])
        eventually(lambda: not buttons.running)
        assert far.ids == []

    def test_stop_that_still_runs_leaves_on_a_network_that_is_added_however_late(
        self, buttons: StopButtons, controller: ScriptedSender, far: ScriptedSender, clock: Turned
    ) -> None:
        controller.answer.clear()
        buttons.press()
        eventually(lambda: len(controller.ids) == 1)
        clock.now += 3600.0
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        eventually(lambda: far.ids == controller.ids)
        controller.answer.set()

    def test_stop_of_some_robots_is_for_the_networks_that_have_them(
        self, buttons: StopButtons, controller: ScriptedSender, far: ScriptedSender
    ) -> None:
        other, one = ScriptedSender(), Scope.named(["arm-1"])
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        buttons.press(one, ["near"])
        eventually(lambda: not buttons.running)
        buttons.add("other", other, lambda scope: ())  # type: ignore[arg-type]
        assert (controller.scopes, far.scopes, other.scopes) == ([one], [], [])
        assert list(buttons.latest) == ["near"]

    def test_robot_that_was_resumed_on_one_network_is_stopped_with_a_new_id(
        self, buttons: StopButtons, controller: ScriptedSender, far: ScriptedSender
    ) -> None:
        buttons.add("far", far, lambda scope: ())  # type: ignore[arg-type]
        controller.refused = {"arm-1": Answer("arm-1", None, 1.0, "this stop was resumed before it came again")}
        for _press in range(2):
            buttons.press()
            eventually(lambda: not buttons.running)
        assert len(set(controller.ids)) == 2
        assert set(far.ids) == {controller.ids[0]}

    @pytest.fixture
    def clock(self, monkeypatch: pytest.MonkeyPatch) -> Turned:
        clock = Turned()
        monkeypatch.setattr(safety_console, "time", clock)
        return clock


class Turned:
    """A monotonic clock that the test turns."""

    now = 1000.0

    def monotonic(self) -> float:
        """Return its seconds."""
        return self.now
