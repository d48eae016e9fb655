from __future__ import annotations

import threading
from collections.abc import Collection
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.cli import button
from strands_robots.cli.button import Button
from strands_robots.safety.controller import Answer, StopReport


class FakeController:
    """Notes each stop and answers when it is told to."""

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.expected: list[Collection[str]] = []
        self.answer = threading.Event()
        self.answer.set()
        self.links: list[bool] = []
        self.refused: dict[str, Answer] = {}
        self.silent: list[tuple[str, ...]] = []

    def stop(self, expected: Collection[str], reason: str, *, estop_id: str, on_progress: Any) -> StopReport:
        self.ids.append(estop_id)
        self.expected.append(expected)
        assert self.answer.wait(60.0)
        link = self.links.pop(0) if self.links else True
        return StopReport(estop_id, {}, {}, self.refused, self.silent.pop(0) if self.silent else (), link, 1.0)


@pytest.fixture
def controller() -> FakeController:
    return FakeController()


def made(controller: FakeController) -> Button:
    return Button(controller, lambda: ("arm-1",), "test")  # type: ignore[arg-type]


def test_a_press_stops_whoever_is_known_then(controller: FakeController) -> None:
    bar = made(controller)
    bar.press()
    eventually(lambda: bar.report is not None and not bar.running)
    assert controller.expected == [("arm-1",)]


def test_a_key_that_is_held_is_one_stop(controller: FakeController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(button, "HELD_S", 60.0)
    bar = made(controller)
    controller.answer.clear()
    for _ in range(50):
        bar.press()
    controller.answer.set()
    eventually(lambda: bar.report is not None)
    bar.press()
    eventually(lambda: not bar.running)
    assert len(set(controller.ids)) == 1
    assert len(controller.ids) <= 2
    assert bar.presses == 51


def test_a_later_press_is_a_stop_of_its_own(controller: FakeController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(button, "HELD_S", 0.0)
    bar = made(controller)
    controller.answer.clear()
    bar.press()
    bar.press()
    eventually(lambda: len(set(controller.ids)) == 2)
    controller.answer.set()
    eventually(lambda: not bar.running)


def test_a_robot_that_was_resumed_meanwhile_is_stopped_under_a_new_name(controller: FakeController) -> None:
    bar = made(controller)
    controller.refused = {"arm-1": Answer("arm-1", None, 1.0, "this stop was resumed before it came again")}
    for presses in (1, 2):
        bar.press()
        eventually(lambda: not bar.running)
        assert len(set(controller.ids)) == presses


def test_a_stop_that_never_left_goes_on_under_its_name(controller: FakeController) -> None:
    controller.links = [False, False, True]
    bar = made(controller)
    bar.press()
    eventually(lambda: bar.report is not None and not bar.running)
    assert len(controller.ids) == 3
    assert len(set(controller.ids)) == 1


def test_a_stop_goes_on_until_nobody_is_silent(controller: FakeController) -> None:
    controller.silent = [("arm-1",), ("arm-1",), ()]
    bar = made(controller)
    bar.press()
    eventually(lambda: not bar.running)
    assert len(controller.ids) == 3
    assert len(set(controller.ids)) == 1
    assert bar.report is not None
    assert bar.report.silent == ()
