"""Rollouts on a Reachy Mini, as on any device with LeRobot's verbs."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from fixtures.reachy_daemon.process import Daemon
from fixtures.waiting import eventually

from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.reachy.target import ACTION_KEYS, BOUNDS
from strands_robots.hardware import HardwareRobot


@pytest.fixture
def robot(reachy: ReachyDriver) -> Iterator[HardwareRobot]:
    made = HardwareRobot(reachy, "mini", control_hz=50)
    yield made
    made.cleanup()


def test_joints_ranges_and_lockout_key_are_those_of_the_driver(robot: HardwareRobot, reachy: ReachyDriver) -> None:
    assert set(robot.get_state()["joints"]) == set(ACTION_KEYS)
    assert robot.get_features()["ranges"] == {key: list(pair) for key, pair in BOUNDS.items()}
    assert robot.safety_key == reachy.safety_key


def test_rollout_moves_the_robot_and_sends_nothing_after_its_end(robot: HardwareRobot, reachy: ReachyDriver) -> None:
    before = reachy.get_observation()
    sent = reachy.motions.frames_sent
    assert robot.start_task("wave", duration=2.0)["status"] == "success"
    eventually(lambda: robot.get_task_status()["task_status"] != "running", what="its end")
    status = robot.get_task_status()
    assert status["task_status"] == "completed", status
    assert reachy.motions.frames_sent - sent >= status["step_count"] > 5
    after = reachy.get_observation()
    assert max(abs(after[key] - before[key]) for key in ACTION_KEYS) > 0.05
    frames = reachy.motions.frames_sent
    time.sleep(0.1)
    assert reachy.motions.frames_sent == frames


def test_halt_ends_a_rollout_and_no_frame_follows(robot: HardwareRobot, reachy: ReachyDriver) -> None:
    robot.start_task("wave", duration=30.0)
    eventually(lambda: robot.get_task_status()["step_count"] > 20, what="steps")
    verdict = robot.halt("test")
    frames = reachy.motions.frames_sent
    assert verdict.stopped is True
    assert verdict.halted == ("task",)
    time.sleep(0.1)
    assert reachy.motions.frames_sent == frames
    assert robot.start_task("again", duration=0.2)["status"] == "success"


def test_halt_of_the_robot_stops_the_moves_of_its_daemon(
    daemon: Daemon, robot: HardwareRobot, reachy: ReachyDriver
) -> None:
    reachy.wake_up()
    assert len(daemon.running_moves()) == 1
    assert robot.halt("test").stopped is True
    assert daemon.running_moves() == []
