"""A safety plane of a test's own, and robots on it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.moments import MomentClock
from fixtures.planes import own_plane
from fixtures.recording_robot import RecordingRobot

from strands_robots.safety import reporting
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.sightings import Sightings

Add = Callable[..., RecordingRobot]


@pytest.fixture(autouse=True)
def patient_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report waits for a slow disk: what is shown is whether a lockout was kept, not how fast."""
    monkeypatch.setattr(reporting, "KEEP_S", 20.0)


@pytest.fixture
def plane(patient_halts: None) -> Iterator[SafetyPlane]:
    with own_plane(None) as here:
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


@pytest.fixture
def clock() -> MomentClock:
    """The clock of ``store``."""
    return MomentClock()


@pytest.fixture
def store(tmp_path: Path, clock: MomentClock) -> Sightings:
    """What a machine of the test's own remembers of robots."""
    return Sightings(tmp_path / "state", clock)


@pytest.fixture
def child() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start Python programs, which the end of the test kills."""
    children: list[subprocess.Popen[str]] = []

    def start(program: str, *arguments: str) -> subprocess.Popen[str]:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        started = subprocess.Popen([sys.executable, "-c", program, *arguments], text=True, **pipes)
        children.append(started)
        return started

    yield start
    for each in children:
        each.kill()
        each.wait()
        for pipe in filter(None, (each.stdin, each.stdout)):
            pipe.close()
