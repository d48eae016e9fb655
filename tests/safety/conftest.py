"""A safety plane of a test's own, and robots on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fixtures.planes import own_plane
from fixtures.recording_robot import RecordingRobot

from strands_robots.safety.plane import SafetyPlane

Add = Callable[..., RecordingRobot]


@pytest.fixture
def plane() -> Iterator[SafetyPlane]:
    with own_plane(0.5) as here:
        yield here


@pytest.fixture
def add(plane: SafetyPlane) -> Iterator[Add]:
    made: list[RecordingRobot] = []

    def one(robot_id: str = "arm-1", key: str | None = None, **robot: Any) -> RecordingRobot:
        made.append(RecordingRobot(**robot))
        plane.register(robot_id, made[-1], key=key)
        return made[-1]

    yield one
    for robot in made:
        robot.close()
