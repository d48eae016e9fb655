"""LeRobot's driver on emulated servos: the tip goes to a point, by the bytes on the bus."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.feetech_bus import FeetechBus, arm_calibration
from fixtures.waiting import eventually

from strands_robots.kinematics.chain import MODELS, built_in
from strands_robots.policies.base import JOINT_SPEED_RAD_S
from strands_robots.utils import ValidationError

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


def written(bus: FeetechBus) -> dict[str, list[tuple[float, float]]]:
    """Goals that reached each servo, as monotonic seconds and radians of the model."""
    goals: dict[str, list[tuple[float, float]]] = {joint: [] for joint in JOINTS}
    entries = arm_calibration()
    for write in bus.writes:
        if write.is_for("goal_position") and write.servo <= len(JOINTS):
            joint = JOINTS[write.servo - 1]
            middle = (entries[joint]["range_min"] + entries[joint]["range_max"]) / 2
            counts = int.from_bytes(write.data[:2], "little")
            goals[joint].append((write.at, math.radians((counts - middle) * 360 / 4095)))
    return goals


@pytest.mark.parametrize("use_degrees", [True, False])
def test_tip_goes_to_the_point_by_the_goals_on_the_bus(arm: Any, bus: FeetechBus, use_degrees: bool) -> None:
    robot = arm(use_degrees=use_degrees)
    answer = robot.move_to(0.25, 0.1, 0.08, speed=1.0)
    assert answer["status"] == "success", answer
    goals = written(bus)
    chain = built_in("so101")
    tip = chain.forward(np.array([goals[joint][-1][1] for joint in JOINTS])).position
    assert np.linalg.norm(tip - np.array([0.25, 0.1, 0.08])) <= 2e-3
    assert answer["error_mm"] < 5.0
    step = 1 / robot.control_hz
    for joint in JOINTS:
        angles = [angle for _, angle in goals[joint]]
        # A goal is a whole count, which is 0.0015 rad.
        assert all(abs(b - a) <= JOINT_SPEED_RAD_S * step + 0.0032 for a, b in itertools.pairwise(angles)), joint


def test_status_after_a_motion_has_its_outcome_and_reads_no_bus(arm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = arm()
    robot.set_gripper(0.0, wait=False)
    robot.wait_for()
    robot.move_to(0.25, 0.1, 0.08, speed=1.0, wait=False)
    eventually(lambda: robot.get_task_status()["task_status"] == "completed", within=30.0)
    monkeypatch.setattr(robot.device, "get_joints", lambda *_: pytest.fail("a status reads no bus"), raising=False)
    monkeypatch.setattr(robot.device.bus, "sync_read", lambda *_, **__: pytest.fail("a status reads no bus"))
    status = robot.get_task_status()
    assert status["outcome"]["asked"].items() >= {"x": 0.25, "y": 0.1, "z": 0.08}.items()
    assert status["outcome"]["error_mm"] < 5.0
    assert (status["task_status"], status["outcome"]["why"]) == ("completed", "it is done")


def test_pose_and_gripper_are_told_and_the_jaws_close(arm: Any) -> None:
    robot = arm()
    pose = robot.arm_pose()
    assert pose["status"] == "success", pose
    assert pose["joints"]["shoulder_pan"] == pytest.approx(0.0, abs=1.0)
    assert robot.set_gripper(1.0)["reached"]["gripper"] == pytest.approx(1.0, abs=0.05)
    assert robot.set_gripper(0.0)["holding"] is False


def test_stop_ends_a_motion_of_a_real_arm_in_its_middle(arm: Any) -> None:
    robot = arm()
    started = robot.move_to(0.2, 0.15, 0.1, speed=0.2, wait=False)
    assert started["task_status"] == "running", started
    eventually(lambda: robot.get_task_status()["step_count"] > 3)
    assert robot.stop_task()["stopped"]
    assert robot.wait_for(started["task_id"])["why"] == "it was stopped"


def test_model_of_another_file_plans_the_arm(arm: Any) -> None:
    robot = arm(model=str(MODELS / "so101.xml"))
    assert robot.move_to(0.25, 0.1, 0.08, speed=1.0)["error_mm"] < 5.0


@pytest.mark.parametrize(
    ("model", "says"),
    [("rover.xml", "rover has no"), ("knee.xml", "has no joint knee"), ("none.xml", "there is no")],
)
def test_model_that_does_not_fit_is_refused_by_name_when_the_robot_is_made(
    arm: Any, bus: FeetechBus, tmp_path: Path, model: str, says: str
) -> None:
    text = (MODELS / "so_arm_links.xml").read_text(encoding="utf-8")
    (tmp_path / "so_arm_links.xml").write_text(text.replace("elbow_flex", "knee"), encoding="utf-8")
    (tmp_path / "knee.xml").write_text(
        (MODELS / "so101.xml").read_text(encoding="utf-8").replace("elbow_flex", "knee"), encoding="utf-8"
    )
    path = MODELS / model if (MODELS / model).is_file() else tmp_path / model
    with pytest.raises(ValidationError, match=says):
        arm(model=str(path))
    # The halt of its end freezes it in the middle, where it is.
    goals = [int.from_bytes(write.data[:2], "little") for write in bus.writes if write.is_for("goal_position")]
    assert all(abs(goal - 2048) <= 2 for goal in goals)
