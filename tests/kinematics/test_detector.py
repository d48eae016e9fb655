"""What a detector sees is checked before an arm is sent to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from fixtures.devices import RecordingDevice

from strands_robots.hardware import HardwareRobot
from strands_robots.kinematics.objects import ObjectDetector, detected
from strands_robots.utils import ValidationError

CUBE = {"name": "cube", "position": [0.2, 0.0, 0.0125], "size": [0.025, 0.025, 0.025]}


class Seeing:
    """Gives what it was made with, and keeps what it was shown."""

    def __init__(self, *rows: Any) -> None:
        self.rows = rows
        self.frames: list[str] = []

    def detect(self, frames: Mapping[str, Any]) -> list[Any]:
        self.frames = list(frames)
        return list(self.rows)


def test_objects_of_a_detector_are_those_of_get_objects() -> None:
    robot = HardwareRobot(RecordingDevice())
    assert "no detector of objects" in robot.get_objects()["reason"]
    detector = Seeing(CUBE, {**CUBE, "name": "plate", "position": np.array([0.2, 0.1, 0.0]), "yaw": 0.5, "fixed": True})
    assert isinstance(detector, ObjectDetector)
    robot.detector = detector
    answer = robot.get_objects()
    assert answer["objects"]["cube"] == {
        **{"x": 0.2, "y": 0.0, "z": 0.0125},
        **{"yaw": 0.0, "size": [0.025, 0.025, 0.025], "fixed": False},
    }
    assert (answer["objects"]["plate"]["yaw"], answer["objects"]["plate"]["fixed"]) == (28.6, True)


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({**CUBE, "name": ""}, "name"),
        ({**CUBE, "name": 5}, "name"),
        ({**CUBE, "position": [0.2, 0.0]}, "position of cube must be three numbers"),
        ({**CUBE, "position": [0.2, float("nan"), 0.0]}, "position of cube"),
        ({**CUBE, "position": [0.2, True, 0.0]}, "position of cube"),
        ({**CUBE, "size": [0.0, 0.1, 0.1]}, "size of cube"),
        ({**CUBE, "yaw": "left"}, "yaw of cube"),
        ({**CUBE, "colour": "red"}, "colour"),
        ("cube", "object"),
    ],
)
def test_unusable_row_is_refused_by_what_is_wrong_with_it(row: Any, says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        detected(Seeing(row), {})


def test_two_objects_of_one_name_are_refused() -> None:
    with pytest.raises(ValidationError, match="two objects the name 'cube'"):
        detected(Seeing(CUBE, CUBE), {})


def test_detector_that_fails_is_an_error_and_no_exception() -> None:
    class Broken:
        def detect(self, frames: Mapping[str, Any]) -> list[Any]:
            raise RuntimeError("no light")

    robot = HardwareRobot(RecordingDevice())
    robot.detector = Broken()
    assert "the detector failed: RuntimeError: no light" in robot.get_objects()["reason"]
