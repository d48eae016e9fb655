"""LeRobot's own SO follower on an emulated servo bus: it settles after a stop, and lets go of a trapped finger."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.feetech_bus import MOTORS, FeetechBus
from fixtures.waiting import eventually

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("patient_settling")]

Arm = Callable[..., Any]

REST = {**dict.fromkeys((f"{motor}.pos" for motor in MOTORS), 0.0), "shoulder_lift.pos": -60.0, "gripper.pos": 10.0}


def settling(arm: Arm) -> Any:
    robot = arm(stop_level="settle", rest_pose=REST)
    robot.start_task("wave", duration=30.0)
    eventually(lambda: robot.get_task_status()["step_count"] > 25)
    verdict = robot.halt("test")
    assert (verdict.stopped, verdict.settling) == (True, True), verdict
    return robot


def test_it_goes_to_its_rest_pose_and_then_its_torque_is_off(arm: Arm, bus: FeetechBus) -> None:
    robot = settling(arm)
    assert "limp" in robot.wait_settled()
    assert robot.get_state()["joints"] == pytest.approx(REST, abs=4.0)
    assert not any(servo.torque for servo in bus.servos.values())
    at = time.monotonic()
    assert robot.halt("again").stopped is True
    assert bus.written_after(at) == []


@pytest.mark.usefixtures("unending_settling")
def test_a_second_stop_freezes_it_with_torque(arm: Arm, bus: FeetechBus) -> None:
    robot = settling(arm)
    assert robot.halt("again").stopped is True
    at = time.monotonic()
    assert "stopped again" in robot.wait_settled()
    assert all(servo.torque for servo in bus.servos.values())
    assert bus.written_after(at) == []


@pytest.mark.usefixtures("unending_settling")
def test_a_servo_that_dies_on_the_way_leaves_the_others_held_with_torque(arm: Arm, bus: FeetechBus) -> None:
    robot = settling(arm)
    bus.servos[3].dead = True
    assert "no status packet" in robot.wait_settled()
    assert all(servo.torque for servo in bus.servos.values())
    bus.servos[3].dead = False


def test_one_motor_lets_go_and_gets_its_torque_back_with_the_next_motion(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    assert robot.release_torque("gripper")["released"] == ["gripper"]
    assert [number for number, servo in bus.servos.items() if not servo.torque] == [6]
    assert robot.halt("test").stopped is True
    assert not bus.servos[6].torque
    assert robot.send_action({"shoulder_pan.pos": 5.0})["status"] == "success"
    assert all(servo.torque for servo in bus.servos.values())
