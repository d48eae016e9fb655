"""Stops of many callers: each is carried out, and a flood costs its sender answers, never a robot its stop."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from fixtures.waiting import eventually

from strands_robots.safety.stop_executor import StopExecutor
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.stops import CALLER_MAX, TOTAL_MAX, Request, StopRequests


@dataclass(eq=False)
class Held:
    """A robot whose halt waits until it is let go."""

    name: str
    let_go: threading.Event
    halts: list[str] = field(default_factory=list)
    begun: threading.Event = field(default_factory=threading.Event)

    def halt(self, reason: str = "") -> StopVerdict:
        self.halts.append(reason)
        self.begun.set()
        self.let_go.wait(60)
        return StopVerdict((self.name,))


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> StopExecutor:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "60")
    return StopExecutor()


@pytest.fixture
def let_go() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def test_a_flood_under_many_names_keeps_its_bound_and_every_robot_its_stop(
    executor: StopExecutor, let_go: threading.Event
) -> None:
    answered: list[Request] = []
    requests = StopRequests(lambda verdict, those: answered.extend(those), lambda: executor)
    robots = [Held(f"robot-{number}", let_go) for number in range(100)]
    requests.add(robots[0], "robot-0", "stop", ("first", "t"))
    assert robots[0].begun.wait(20)
    requests.add(robots[0], "robot-0", "stop", ("console", "t"))
    for number in range(TOTAL_MAX + 500):
        requests.add(robots[number % 100], "robot", "stop", (f"sender-{number % 100}", f"t{number}"))
    assert len(requests) <= TOTAL_MAX
    let_go.set()
    eventually(lambda: len(requests) == 0)
    assert ("console", "t") in answered
    assert requests.unanswered >= 500
    assert all(robot.halts for robot in robots)
    assert len(robots[0].halts) <= 3, "stops that wait share the next halt"


def test_a_stop_that_lost_its_answer_to_a_flood_is_carried_out_all_the_same(
    executor: StopExecutor, let_go: threading.Event
) -> None:
    answered: list[Request] = []
    requests = StopRequests(lambda verdict, those: answered.extend(those), lambda: executor)
    left, right = Held("left", let_go), Held("right", let_go)
    requests.add(left, "left", "stop", ("one", "t0"))
    for turn in range(CALLER_MAX):
        requests.add(right, "right", "stop", ("one", f"t{turn + 1}"))
    let_go.set()
    eventually(lambda: len(requests) == 0)
    assert left.halts
    assert requests.unanswered == 1
    assert ("one", "t0") not in answered


def test_the_next_halt_waits_for_no_answer_to_the_one_before(executor: StopExecutor, let_go: threading.Event) -> None:
    free = threading.Event()
    free.set()
    answered: list[Request] = []
    requests = StopRequests(lambda verdict, those: answered.extend(those if let_go.wait(60) else []), lambda: executor)
    robots = [Held(name, free) for name in ("one", "left", "right")]
    for robot in robots:
        requests.add(robot, robot.name, "stop", ("console", robot.name))
    eventually(lambda: all(robot.halts for robot in robots))
    assert answered == []
    assert len(requests) == 3
    let_go.set()
    eventually(lambda: len(requests) == 0)
    assert sorted(turn for _, turn in answered) == ["left", "one", "right"]


def test_a_request_that_is_repeated_is_answered_once(executor: StopExecutor, let_go: threading.Event) -> None:
    answered: list[Request] = []
    requests = StopRequests(lambda verdict, those: answered.extend(those), lambda: executor)
    robot = Held("one", let_go)
    for _ in range(5):
        requests.add(robot, "one", "stop", ("console", "t"))
    let_go.set()
    eventually(lambda: len(requests) == 0)
    assert answered == [("console", "t")]
