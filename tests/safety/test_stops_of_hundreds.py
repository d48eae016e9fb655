"""Stops of large processes: the order of halts and answers."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.safety import reporting
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.estop_listener import VERDICT, notification
from strands_robots.safety.orders import ANSWERED, ANSWERED_MAX_BYTES, StopOrder, StopRules, answered_field, new_epoch
from strands_robots.safety.plane import SafetyPlane

Add = Callable[..., RecordingRobot]


class RepeatingLink:
    """Robots that answer one after the other: one more at each sending."""

    def __init__(self, names: list[str], **fields: Any) -> None:
        self.up = True
        self.sent: list[dict[str, Any]] = []
        self._names, self._fields = names, fields
        self._hear: Callable[[str, str, bytes], None] = lambda event, source, payload: None

    def open(self, events: object, hear: Callable[[str, str, bytes], None], on_state: object) -> None:
        self._hear = hear

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        self.sent.append(json.loads(payload)["params"])
        for name in self._names[len(self.sent) - 1 : len(self.sent)]:
            answer = {"device_id": name, "estop_id": self.sent[0]["estop_id"], "stopped": True, **self._fields}
            self._hear(VERDICT, name, notification(VERDICT, answer))
        return True

    def close(self) -> None:
        self.up = False


def order(answered: tuple[str, ...] = (), epoch: str = "") -> StopOrder:
    return StopOrder(epoch or new_epoch(), "safety-1", "smoke", answered=frozenset(answered))


def test_each_repetition_names_the_robots_that_have_answered() -> None:
    names = ["arm-1", "arm-2", "arm-3"]
    link = RepeatingLink(names)
    assert SafetyController("safety-1", lambda: link).stop(names, deadline_s=20).ok
    assert [set(each.get(ANSWERED, ())) for each in link.sent[:3]] == [set(), {"arm-1"}, {"arm-1", "arm-2"}]


@pytest.mark.parametrize("fields", [{"stopped": False}, {"stopped": None}, {"persisted": False}])
def test_a_robot_that_has_more_to_say_is_asked_again(fields: dict[str, Any]) -> None:
    link = RepeatingLink(["arm-1", "arm-2"], **fields)
    SafetyController("safety-1", lambda: link).stop(["arm-1", "arm-2"], deadline_s=20)
    assert len(link.sent) >= 2
    assert all(ANSWERED not in each for each in link.sent)


def test_a_robot_whose_answer_is_there_does_not_repeat_it(plane: SafetyPlane, add: Add) -> None:
    add("arm-1"), add("arm-2")
    first, repeated = order(), []
    assert plane.emergency_stop(first).keys() == {"arm-1", "arm-2"}
    plane.begin(order(("arm-1",), first.epoch), lambda report: repeated.append(report.robot_id))
    assert repeated == ["arm-2"]


def test_a_robot_that_did_not_stop_says_so_at_each_repetition(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    release, repeated = threading.Event(), []
    add("arm-1", before_halt=lambda: release.wait(60))
    first = order()
    assert plane.emergency_stop(first)["arm-1"].stopped is False
    plane.begin(order(("arm-1",), first.epoch), lambda report: repeated.append(report.robot_id))
    assert repeated == ["arm-1"]
    release.set()


def test_a_robot_that_is_named_as_answered_is_halted_by_a_stop_that_it_has_not_seen(
    plane: SafetyPlane, add: Add
) -> None:
    robot = add("arm-1")
    assert plane.emergency_stop(order(("arm-1",)))["arm-1"].stopped is True
    assert robot.refuses()


@pytest.mark.parametrize("stated", [None, "arm-1", 3, {"arm-1": 1}, [["arm-1"], None, 3]])
def test_a_stop_counts_whatever_it_names_as_answered(stated: object) -> None:
    decided = StopRules(allow=(), keys=()).order("safety-1", {"estop_id": new_epoch(), ANSWERED: stated}, "lane")
    assert isinstance(decided, StopOrder)
    assert decided.answered == frozenset()


def test_the_names_of_those_that_answered_are_bounded() -> None:
    names = [f"arm-{number:05}" for number in range(20_000)]
    named = answered_field(names)[ANSWERED]
    assert 0 < len(json.dumps(named)) <= ANSWERED_MAX_BYTES
    assert answered_field([]) == {}


def test_no_robot_of_a_large_process_answers_before_the_last_has_halted(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "UNPACED", 3)
    monkeypatch.setattr(reporting, "PACE_S", 2.0)
    events, last = [], threading.Event()

    def halt() -> None:
        events.append("halt")

    for number in range(3):
        add(f"arm-{number}", before_halt=halt)
    add("arm-3", before_halt=lambda: (last.wait(60), halt()))
    run = plane.begin(order(), lambda report: events.append("answer"))
    assert run is not None
    eventually(lambda: len(events) == 3)
    run.wait(10 * reporting.GRACE_S)  # the time in which robots of a small process answer
    last.set()
    assert run.wait(60)
    assert events == ["halt"] * 4 + ["answer"] * 4
