"""The content of a calibration file, checked."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.feetech_bus import MOTORS, arm_calibration

from strands_robots.hardware.body import DeviceBody
from strands_robots.hardware.lerobot_device import Calibrator, calibrate_from, checked_calibration
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


class LosingBus:
    """A bus that loses the first answers while it is connected."""

    def __init__(self, lost: int, problem: Exception) -> None:
        self.lost, self.problem = lost, problem
        self.motors = dict.fromkeys(MOTORS)
        self.connections = 0
        self.modes: list[str] = []
        self.set_half_turn_homings = dict

    def connect(self) -> None:
        self.connections += 1
        if self.connections <= self.lost:
            raise self.problem

    def disable_torque(self) -> None:
        pass

    def write(self, register: str, motor: str, value: int) -> None:
        self.modes.append(motor)


def caused_by(cause: Exception) -> ConnectionError:
    """Return LeRobot's error of a port that it could not connect on."""
    problem = ConnectionError("Could not connect on port '/dev/ttyACM0'")
    problem.__cause__ = cause
    return problem


LOST = (ConnectionError("There is no status packet!"), RuntimeError("Missing motor IDs: 6"))


@pytest.mark.parametrize("problem", [*LOST, caused_by(LOST[0])], ids=["answer", "ping", "answer, as of the port"])
def test_a_lost_answer_does_not_end_a_calibration_that_begins(problem: Exception) -> None:
    bus = LosingBus(2, problem)
    Calibrator(SimpleNamespace(bus=bus)).begin()
    assert bus.connections == 3
    assert bus.modes == list(MOTORS)


def test_a_port_that_is_not_there_is_tried_once() -> None:
    bus = LosingBus(9, caused_by(OSError("Failed to open port")))
    with pytest.raises(ConnectionError):
        Calibrator(SimpleNamespace(bus=bus)).begin()
    assert bus.connections == 1


@pytest.mark.parametrize("problem", [*LOST, caused_by(LOST[0])], ids=["answer", "ping", "answer, as of the port"])
def test_a_lost_answer_does_not_keep_an_arm_from_connecting(problem: Exception) -> None:
    bus = LosingBus(2, problem)
    DeviceBody.bring_up(SimpleNamespace(connect=bus.connect))
    assert bus.connections == 3


def test_driver_that_brings_the_calibration_of_its_motors_needs_no_file() -> None:
    bus = SimpleNamespace(motors={"joint1": None}, calibration={"joint1": object()}, port="can0")
    device = SimpleNamespace(bus=bus, calibration={}, calibration_fpath=Path("none.json"), id="piper")
    calibrate_from(device, None, name="piper", role="follower")
    bus.calibration = {}
    with pytest.raises(ValidationError, match="has no calibration"):
        calibrate_from(device, None, name="piper", role="follower")
