"""A controller whose link is up and brings no answer has it made anew, whichever of its stops goes unanswered."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator

import pytest

from strands_robots.safety import controller as controllers
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.stop_link import ESTOP, VERDICT, notification


class DeafLink:
    """Up, and carries nothing to those who are not among ``reached``; counts how often it was made anew."""

    def __init__(self) -> None:
        self.up, self.renewed, self.reached = True, 0, set[str]()
        self._hear: Callable[[str, str, bytes], None] = lambda event, source, payload: None

    def open(self, events: object, hear: Callable[[str, str, bytes], None], on_state: object) -> None:
        self._hear = hear

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        if event == ESTOP:
            estop_id = json.loads(payload)["params"]["estop_id"]
            for name in self.reached:
                answer = {"device_id": name, "estop_id": estop_id, "stopped": True}
                self._hear(VERDICT, name, notification(VERDICT, answer))
        return True

    def renew(self) -> None:
        self.renewed += 1

    def close(self) -> None:
        self.up = False


class SteppingClock:
    """Goes on by 10 ms with every look, so that how long a stop has lasted depends on no machine."""

    time = staticmethod(time.time)

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        self._now += 0.01
        return self._now


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> DeafLink:
    monkeypatch.setattr(controllers, "time", SteppingClock())
    monkeypatch.setattr(controllers, "RENEW_S", 0.3)
    monkeypatch.setattr(controllers, "SETTLE_S", 0.05)
    return DeafLink()


@pytest.fixture
def hand(link: DeafLink) -> Iterator[SafetyController]:
    made = SafetyController("safety-1", lambda: link)
    yield made
    made.close()


def test_short_stops_without_an_answer_add_up(hand: SafetyController, link: DeafLink) -> None:
    hand.stop(["arm-1"], deadline_s=0.2)
    assert link.renewed == 0
    hand.stop(["arm-1"], deadline_s=0.2)
    assert link.renewed == 1


def test_one_robot_that_is_silent_among_others_is_enough(hand: SafetyController, link: DeafLink) -> None:
    link.reached = {"arm-1"}
    report = hand.stop(["arm-1", "arm-2"], deadline_s=0.55)
    assert report.silent == ("arm-2",)
    assert link.renewed == 1


def test_an_answered_stop_begins_the_count_again(hand: SafetyController, link: DeafLink) -> None:
    hand.stop(["arm-1"], deadline_s=0.2)
    link.reached = {"arm-1"}
    assert hand.stop(["arm-1"], deadline_s=0.2).ok
    link.reached = set()
    hand.stop(["arm-1"], deadline_s=0.2)
    assert link.renewed == 0


def test_a_new_stop_has_a_moment_for_its_answers_first(hand: SafetyController, link: DeafLink) -> None:
    hand.stop(["arm-1"], deadline_s=0.29)
    link.reached = {"arm-1"}
    assert hand.stop(["arm-1"], deadline_s=0.2).ok
    assert link.renewed == 0


def test_a_link_that_is_down_is_left_to_come_back_by_itself(hand: SafetyController, link: DeafLink) -> None:
    link.up = False
    hand.stop(["arm-1"], deadline_s=0.55)
    assert link.renewed == 0
