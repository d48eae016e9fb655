"""The threads that stand ready to halt: a halt that is stuck holds up neither the next one nor the robot's leaving."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from fixtures.waiting import eventually

from strands_robots.safety.gate import MotionGate
from strands_robots.safety.halting import HaltWorker
from strands_robots.safety.stopping import StopVerdict


class Wedged:
    """Hangs in its first halt until it is let go; answers every later one."""

    def __init__(self) -> None:
        self.gate = MotionGate()
        self.reasons: list[str] = []
        self.go_on = threading.Event()

    def halt(self, reason: str = "") -> StopVerdict:
        self.reasons.append(reason)
        if len(self.reasons) == 1:
            self.go_on.wait(60)
        return StopVerdict()


@pytest.fixture
def robot() -> Iterator[Wedged]:
    made = Wedged()
    yield made
    made.go_on.set()


def threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "halt-wedged-1"}


def wedge(robot: Wedged) -> HaltWorker:
    worker = HaltWorker(robot, "wedged-1")
    worker.halt("first", lambda verdict: None)
    eventually(lambda: robot.reasons == ["first"])
    return worker


def test_a_halt_that_waits_behind_a_stuck_one_is_done_by_the_fresh_thread(robot: Wedged) -> None:
    worker, second = wedge(robot), threading.Event()
    worker.halt("second", lambda verdict: second.set())
    worker.renew()
    assert second.wait(20)
    robot.go_on.set()
    worker.close(20)
    eventually(lambda: not threads())
    assert robot.reasons == ["first", "second"]


def test_a_robot_that_left_while_it_was_stuck_leaves_no_thread_behind(robot: Wedged) -> None:
    worker, second = wedge(robot), threading.Event()
    worker.halt("second", lambda verdict: second.set())
    worker.close(0.0)
    worker.renew()
    assert second.wait(20), "what was ordered before it left is done"
    robot.go_on.set()
    eventually(lambda: not threads())
    worker.renew()
    eventually(lambda: not threads())
