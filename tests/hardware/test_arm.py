"""A real arm's joints are those of its model, and a model that does not fit is refused by the joint."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from strands_robots.bus_access import action_ranges
from strands_robots.hardware.arm import arm_of
from strands_robots.hardware.device_facts import default_speeds
from strands_robots.utils import ValidationError

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def device(mode: str = "DEGREES", name: str = "so101_follower", **changed: Any) -> Any:
    """Return a stand-in for LeRobot's follower, calibrated over 220 degrees a joint."""
    ranges = dict.fromkeys(MOTORS, (796, 3299)) | {"wrist_roll": (0, 4095)} | changed
    calibration = {
        motor: SimpleNamespace(range_min=low, range_max=high, drive_mode=0) for motor, (low, high) in ranges.items()
    }
    modes = dict.fromkeys(MOTORS, mode) | {"gripper": "RANGE_0_100"}
    motors = {motor: SimpleNamespace(norm_mode=SimpleNamespace(name=modes[motor]), model="sts3215") for motor in MOTORS}
    keys = {f"{motor}.pos": float for motor in MOTORS}
    bus = SimpleNamespace(motors=motors, calibration=calibration, sync_read=lambda *_: {})
    return SimpleNamespace(
        name=name, bus=bus, action_features=keys, observation_features=keys, get_observation=lambda: {}
    )


def arm(made: Any, model: str | None = None) -> Any:
    return arm_of(made, action_ranges(made), model)


@pytest.mark.parametrize("mode", ["DEGREES", "RANGE_M100_100"])
def test_middle_of_every_range_is_the_zero_of_the_model(mode: str) -> None:
    made = arm(device(mode))
    state = made.state({f"{motor}.pos": 0.0 for motor in MOTORS})
    assert state.joints == pytest.approx(np.zeros(5))
    assert state.opening == 0.0
    there = made.action(np.array([0.5, -0.5, 0.25, 1.0, -1.0]))
    per_radian = 180 / math.pi if mode == "DEGREES" else 100 / math.radians(2503 / 2 * 360 / 4095)
    assert there["shoulder_pan.pos"] == pytest.approx(0.5 * per_radian)
    assert made.state({**there, "gripper.pos": 40.0}).joints == pytest.approx([0.5, -0.5, 0.25, 1.0, -1.0])
    assert made.state({**there, "gripper.pos": 40.0}).opening == pytest.approx(0.4)
    assert made.grip(0.25) == {"gripper.pos": 25.0}


def test_joints_stay_within_their_calibration_and_the_model() -> None:
    made = arm(device(elbow_flex=(1200, 2900)))
    low, high = made.chain.joints[2].low, made.chain.joints[2].high
    assert (low, high) == pytest.approx((-math.radians(1700 / 2 * 360 / 4095), math.radians(1700 / 2 * 360 / 4095)))
    assert made.chain.joints[1].high == pytest.approx(1.74533)


def test_so100_has_the_kinematics_of_the_so101() -> None:
    assert arm(device(name="so100_follower")).chain.label == "so101"


@pytest.mark.parametrize(
    ("made", "model", "reason"),
    [
        (device(shoulder_lift=(1700, 2400)), None, "shoulder_lift is calibrated for 62 degrees and turns 200 in"),
        (device(name="koch_follower"), None, "no model of koch_follower is known; give model"),
        (device(), "/nowhere/arm.xml", "there is no '/nowhere/arm.xml'"),
        (device("RANGE_0_100"), None, "shoulder_pan is told in percent"),
    ],
    ids=["another range", "no model", "no file", "no degrees"],
)
def test_model_that_does_not_fit_is_refused_by_name(made: Any, model: str | None, reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        arm(made, model)


def test_inverted_joint_is_refused_because_its_sign_is_not_known() -> None:
    made = device()
    made.bus.calibration["wrist_flex"].drive_mode = 1
    with pytest.raises(ValidationError, match="wrist_flex is calibrated with drive_mode 1"):
        arm(made)


def test_device_without_a_joint_of_the_model_is_refused() -> None:
    made = device()
    for part in (made.action_features, made.bus.motors):
        part.pop("wrist_roll.pos", None)
        part.pop("wrist_roll", None)
    with pytest.raises(ValidationError, match="so101_follower has no joint wrist_roll"):
        arm(made)


@pytest.mark.parametrize("mode", ["DEGREES", "RANGE_M100_100"])
def test_default_speed_of_a_real_joint_is_two_radians_a_second_in_its_unit(mode: str) -> None:
    per_radian = 180 / math.pi if mode == "DEGREES" else 100 / math.radians(2503 / 2 * 360 / 4095)
    speeds = default_speeds(device(mode))
    assert speeds["shoulder_pan.pos"] == pytest.approx(2 * per_radian)
    assert "gripper.pos" not in speeds


def test_motions_are_planned_within_the_speed_limit() -> None:
    made = arm_of(device(), action_ranges(device()), None, {"shoulder_pan.pos": 18.0, "elbow_flex.pos": 500.0})
    assert made.bounds.speed == pytest.approx([math.radians(18), 2.0, 2.0, 2.0, 2.0])
