"""The content of a calibration file, checked."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.feetech_bus import MOTORS, arm_calibration

from strands_robots.hardware.calibration import calibrate_from, checked_calibration
from strands_robots.utils import ValidationError

IDS = {motor: number for number, motor in enumerate(MOTORS, start=1)}


def test_a_calibration_of_lerobots_is_taken_as_it_is() -> None:
    assert checked_calibration(arm_calibration(), IDS) == arm_calibration()


@pytest.mark.parametrize("content", [None, [], {}, {"gripper": {}}, {**arm_calibration(), "elbow": {}}])
def test_another_arms_calibration_is_refused(content: Any) -> None:
    with pytest.raises(ValidationError, match="calibration must be"):
        checked_calibration(content, IDS)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("id", 9),
        ("drive_mode", 2),
        ("homing_offset", 2048),
        ("homing_offset", 1.5),
        ("range_min", -1),
        ("range_min", 3300),
        ("range_max", 4096),
        ("range_max", True),
    ],
)
def test_a_number_outside_its_domain_is_refused_by_name(field: str, value: Any) -> None:
    content = arm_calibration()
    content["gripper"][field] = value
    with pytest.raises(ValidationError, match=r"calibration\['gripper'\] (range_max|" + field + ")"):
        checked_calibration(content, IDS)


def test_a_field_that_is_not_there_is_named() -> None:
    content = arm_calibration()
    del content["gripper"]["homing_offset"]
    with pytest.raises(ValidationError, match="lacks homing_offset"):
        checked_calibration(content, IDS)


def test_a_device_without_motors_takes_no_calibration() -> None:
    calibrate_from(object(), None, name="hand", role="follower")
    with pytest.raises(ValidationError, match="hand has none"):
        calibrate_from(object(), {}, name="hand", role="follower")
