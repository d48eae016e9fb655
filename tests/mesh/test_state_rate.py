"""Rate of the state: few while the robot is idle, ten a second and the first at once while it moves."""

from __future__ import annotations

from typing import Any

import pytest

from strands_robots.mesh.state import ACTIVE_S, StateRate
from strands_robots.safety.gate import MotionGate

STILL: dict[str, Any] = {"joints": {"pan": 0.5}, "task": {"status": "idle"}}


class Rated:
    """A robot at a clock of the test's; it counts the states that were hurried."""

    def __init__(self) -> None:
        self.now, self.hurried = 100.0, 0
        self.epochs: tuple[str, ...] = ()
        self.gate = MotionGate()
        self.rate = StateRate(self.gate, lambda: self.epochs, self.hurry, lambda: self.now)
        self.gate.watch(self.rate.begins)
        self.rate.published(STILL)
        self.rest()

    def hurry(self) -> None:
        self.hurried += 1

    def rest(self) -> None:
        self.now += ACTIVE_S + 0.1
        self.rate.published(STILL)
        assert not self.rate.active


@pytest.fixture
def robot() -> Rated:
    return Rated()


def test_first_state_of_a_motion_is_hurried_and_those_after_it_are_not(robot: Rated) -> None:
    for _ in range(50):
        robot.gate.permit("send_action")
        robot.rate.look()
    assert robot.hurried == 1
    assert robot.rate.active
    robot.rest()
    robot.gate.permit("execute")
    assert robot.hurried == 2


def test_stream_of_permits_keeps_the_rate(robot: Rated) -> None:
    for _ in range(30):
        robot.now += 0.1
        robot.gate.permit("send_action")
        robot.rate.look()
    assert robot.rate.active
    assert robot.hurried == 1


def test_change_of_the_lockouts_and_a_halt_are_hurried_once(robot: Rated) -> None:
    for change in (("a" * 32,), ("a" * 32, "b" * 32), ()):
        before, robot.epochs = robot.hurried, change
        for _ in range(3):
            robot.rate.look()
        assert robot.hurried == before + 1
    robot.gate.revoke()
    robot.rate.look()
    assert robot.hurried == 4


@pytest.mark.parametrize(
    "body",
    [
        {"joints": {"pan": 0.6}},
        {"joints": {"pan": {"position": 0.6, "velocity": None}}},
        {"joints": {"pan": 0.5, "tilt": 0.0}},
        {**STILL, "task": {"status": "running"}},
        {**STILL, "robots": {"arm-1": False, "arm-2": True}},
    ],
)
def test_state_that_tells_of_a_motion_keeps_the_rate(robot: Rated, body: dict[str, Any]) -> None:
    robot.rate.published(body)
    assert robot.rate.active


def test_flag_in_place_of_a_position_is_no_motion(robot: Rated) -> None:
    robot.rate.published({"joints": {"pan": 0.5, "enabled": True}})
    assert not robot.rate.active


def test_noise_of_a_joint_is_no_motion_and_slow_motion_adds_up(robot: Rated) -> None:
    robot.rate.published({"joints": {"pan": 0.5005}})
    assert not robot.rate.active
    robot.rate.published({"joints": {"pan": 0.5011}})
    assert robot.rate.active
