"""LeRobot's own SO follower on an emulated servo bus: connected, driven, halted, and what its bus does wrong."""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.feetech_bus import MOTORS, FeetechBus, arm_calibration, arm_servos
from fixtures.waiting import eventually

from strands_robots.hardware import _compat, body
from strands_robots.hardware.emulated import HIGH, LOW
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.system

Arm = Callable[..., Any]

KEYS = tuple(f"{motor}.pos" for motor in MOTORS)


def test_the_stand_ins_are_gone_once_the_driver_is_imported() -> None:
    robots = _compat.lerobot_module("lerobot.robots")
    follower = _compat.lerobot_module("lerobot.robots.so_follower")
    assert follower.SO101Follower.__module__ == "lerobot.robots.so_follower.so_follower"
    assert robots.RobotConfig.get_known_choices()["so101_follower"] is follower.SO101FollowerConfig
    assert _compat.light()
    for name in ("torch", "accelerate", "datasets", "lerobot.processor"):
        assert name not in sys.modules
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("torch")


def test_it_connects_with_a_given_calibration_and_reads_its_joints(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    assert all(servo.torque for servo in bus.servos.values())
    state = robot.get_state()
    assert set(state["joints"]) == set(KEYS)
    assert all(abs(state["joints"][key]) < 1 for key in KEYS[:5])
    features = robot.get_features()
    assert features["ranges"]["gripper.pos"] == [0.0, 100.0]
    assert features["ranges"]["shoulder_pan.pos"] == pytest.approx([-109.9, 109.9], abs=0.1)


def test_a_calibration_of_lerobots_own_file_is_read(arm: Arm, bus: FeetechBus, tmp_path: Path) -> None:
    folder = tmp_path / "lerobot"
    folder.mkdir()
    (folder / "left.json").write_text(json.dumps(arm_calibration()), encoding="utf-8")
    robot = arm(calibration=None, id="left")
    assert robot.device.is_calibrated
    assert not [write for write in bus.writes if write.is_for("homing_offset")], "nothing differed"


def test_a_missing_calibration_is_one_sentence_with_the_command(arm: Arm, bus: FeetechBus) -> None:
    with pytest.raises(
        ValidationError, match=r"run strands-robots calibrate so101 --port \S+ --id left, or"
    ) as refused:
        arm(calibration=None, id="left")
    assert "\n" not in str(refused.value)
    assert bus.writes == []


def test_factory_servos_are_given_the_calibration_with_their_torque_off(tmp_path: Path, arm: Arm) -> None:
    with FeetechBus(arm_servos(calibrated=False), link=tmp_path / "fresh") as fresh:
        for servo in fresh.servos.values():
            servo.put("torque_enable", 1)
        robot = arm(port=fresh.port)
        assert robot.device.is_calibrated
        writes = fresh.writes
        offset = next(index for index, write in enumerate(writes) if write.is_for("homing_offset"))
        released = [each.servo for each in writes[:offset] if each.is_for("torque_enable") and each.data == b"\0"]
        assert sorted(released) == [1, 2, 3, 4, 5, 6]
        robot.cleanup()


@pytest.mark.parametrize(
    ("motor", "change", "words"),
    [
        ("gripper", {"range_max": 5000}, "range_max"),
        ("gripper", {"range_min": 3300}, "range_max"),
        ("wrist_flex", {"homing_offset": True}, "homing_offset"),
        ("elbow_flex", {"id": 2}, "id must be"),
    ],
)
def test_a_calibration_outside_its_domain_is_refused(arm: Arm, motor: str, change: dict[str, int], words: str) -> None:
    content = arm_calibration()
    content[motor] |= change
    with pytest.raises(ValidationError, match=words):
        arm(calibration=content)


def test_a_port_that_is_not_there_is_told(arm: Arm) -> None:
    with pytest.raises(ConnectionError, match="no-such-port"):
        arm(port="/dev/no-such-port")


def test_no_port_at_all_is_one_sentence_that_says_what_it_is(arm: Arm) -> None:
    for port in (None, "", 5):
        with pytest.raises(ValidationError, match="so101 needs port, its serial port, such as /dev/ttyACM0") as refused:
            arm(port=port)
        assert "\n" not in str(refused.value)


def test_a_first_connection_that_failed_can_be_tried_again(arm: Arm, bus: FeetechBus) -> None:
    bus.servos[3].dead = True
    with pytest.raises(ConnectionError, match="Missing motor IDs"):
        arm()
    bus.servos[3].dead = False
    assert arm().get_state()["joints"]


def test_it_takes_one_action_and_goes_there(arm: Arm) -> None:
    robot = arm()
    answer = robot.send_action({"shoulder_pan.pos": 30.0})
    assert answer["sent"] == {"shoulder_pan.pos": 30.0}
    eventually(lambda: abs(robot.get_state()["joints"]["shoulder_pan.pos"] - 30) < 0.2, what="arrival")


def test_a_rollout_goes_on_while_the_state_is_read(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    robot.get_state()  # a busy machine may give the first read of the rollout no turn in time
    before, ages = time.monotonic(), []
    assert robot.start_task("wave", duration=3.0)["status"] == "success"
    while robot.get_task_status()["task_status"] == "running":
        state = robot.get_state()
        assert set(state["joints"]) == set(KEYS)
        ages.append(state["joints_age_s"])
        time.sleep(0.1)
    status = robot.get_task_status()
    assert status["task_status"] == "completed", status
    # Of 150 steps; benchmarks/ measures the rate, and how old the joints are.
    assert status["step_count"] >= 10
    assert min(ages) < 2.0
    for servo in range(1, 7):
        assert len([write for write in bus.written_after(before) if write.servo == servo]) >= status["step_count"]


@pytest.mark.parametrize(("level", "torque"), [("hold", True), ("release", False)])
def test_nothing_is_written_after_a_halt_and_torque_is_as_configured(
    arm: Arm, bus: FeetechBus, level: str, torque: bool
) -> None:
    robot = arm(stop_level=level)
    robot.start_task("wave", duration=30.0)
    eventually(lambda: robot.get_task_status()["step_count"] > 25)
    verdict = robot.halt("test")
    at = time.monotonic()
    assert verdict.stopped is True, verdict
    time.sleep(0.1)
    still = bus.shafts()
    time.sleep(0.1)
    assert [write for write in bus.writes if write.at > at] == []
    assert bus.shafts() == pytest.approx(still, abs=1.0)
    assert [servo.torque for servo in bus.servos.values()] == [torque] * 6


def test_torque_at_a_stop_is_as_the_environment_says(
    arm: Arm, bus: FeetechBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "limp")
    assert arm().halt().stopped is True
    assert not any(servo.torque for servo in bus.servos.values())


def test_a_dead_servo_ends_the_rollout_and_is_never_called_stopped(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    robot.start_task("wave", duration=30.0)
    eventually(lambda: robot.get_task_status()["step_count"] > 10)
    bus.servos[3].dead = True
    eventually(lambda: robot.get_task_status()["task_status"] == "error")
    assert "no status packet" in robot.get_task_status()["error"]
    assert robot.halt().stopped is not True
    bus.servos[3].dead = False
    assert robot.halt().stopped is True
    assert robot.start_task("wave", duration=0.2)["status"] == "success"


@pytest.mark.parametrize("options", [{}, {"max_relative_target": 120.0}], ids=["plain", "bounded by LeRobot"])
def test_a_servo_that_dies_in_motion_leaves_the_others_held(
    arm: Arm, bus: FeetechBus, options: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(body, "HOLD_FRESH_S", 20.0)
    robot = arm(**options)
    robot.send_action({"shoulder_pan.pos": 90.0, "wrist_flex.pos": 80.0})
    time.sleep(0.1)
    seen = robot.get_state()["joints"]["shoulder_pan.pos"]
    bus.servos[3].dead = True
    at = time.monotonic()
    assert robot.halt().stopped is not True
    held = [int.from_bytes(write.data, "little") for write in bus.written_after(at) if write.servo == 1]
    assert held == pytest.approx([(LOW + HIGH) / 2 + seen * 4095 / 360], abs=1.5), "where it was last seen"


def test_a_release_lets_go_of_every_motor_that_answers(arm: Arm, bus: FeetechBus) -> None:
    robot = arm(stop_level="release")
    bus.servos[3].dead = True
    verdict = robot.halt()
    assert verdict.stopped is not True
    assert "elbow_flex" in str(verdict)
    assert [number for number, servo in bus.servos.items() if servo.torque] == [3]


def test_an_unplugged_arm_is_told_and_comes_back_when_a_motion_is_asked_for(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    robot.start_task("wave", duration=30.0)
    eventually(lambda: robot.get_task_status()["step_count"] > 10)
    bus.unplug()
    eventually(lambda: robot.get_task_status()["task_status"] == "error")
    assert "port is gone" in robot.get_state()["joints_error"]
    verdict = robot.halt()
    assert verdict.stopped is None
    assert "port is gone" in str(verdict)
    refused = robot.start_task("wave", duration=1.0)
    assert "lost its port" in refused["reason"]
    assert robot.halt().stopped is None, "a try that failed does not make it stopped"
    bus.plug()
    assert robot.start_task("wave", duration=0.3)["status"] == "success"
    eventually(lambda: robot.get_task_status()["task_status"] == "completed")
    assert robot.halt().stopped is True


def test_a_halt_freezes_an_arm_whose_port_is_back_and_a_task_connects_it_again(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    robot.start_task("wave", duration=30.0)
    eventually(lambda: robot.get_task_status()["step_count"] > 10)
    bus.unplug()
    eventually(lambda: robot.get_task_status()["task_status"] == "error")
    bus.plug()
    plugged = time.monotonic()
    assert robot.halt().stopped is True
    assert {write.servo for write in bus.written_after(plugged)} == set(bus.servos), "each servo has a new goal"
    assert not bus.written_after(plugged, "torque_enable"), "an arm that is frozen is not let go of"
    assert robot.start_task("wave", duration=0.3)["status"] == "success"
    eventually(lambda: robot.get_task_status()["task_status"] == "completed")
    assert bus.written_after(plugged, "torque_enable"), "it is configured anew"


@pytest.mark.parametrize("options", [{}, {"max_relative_target": 20.0}], ids=["plain", "bounded by LeRobot"])
def test_a_lost_answer_now_and_then_does_not_end_a_rollout(
    arm: Arm, bus: FeetechBus, options: dict[str, float]
) -> None:
    robot = arm(**options)
    bus.drop_every = 7
    robot.start_task("wave", duration=2.0)
    eventually(lambda: robot.get_task_status()["task_status"] != "running")
    bus.drop_every = 0
    assert robot.get_task_status()["task_status"] == "completed", robot.get_task_status()


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next(arm: Arm, bus: FeetechBus) -> None:
    robot = arm()
    bus.latency_s = 0.5
    assert "joints_error" in robot.get_state()
    bus.latency_s = 0.0
    eventually(lambda: "joints_error" not in robot.get_state())
    robot.send_action({"shoulder_pan.pos": 40.0})
    eventually(lambda: bus.shafts()[1] > 2148 + 454, what="40 degrees from the middle")
    assert robot.get_state()["joints"]["shoulder_pan.pos"] == pytest.approx(40.0, abs=0.3)
