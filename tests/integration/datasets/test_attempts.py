"""Attempts whose cameras fail: named, and never an episode without them."""

from __future__ import annotations

import io
import resource
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from strands_robots.cli import dataset_recording
from strands_robots.cli.dataset_recording import Attempts, record_attempts
from strands_robots.cli.local_recording import Driver, LocalAttempts
from strands_robots.cli.output import CliError, Screen
from strands_robots.datasets.session import RecordingSession
from strands_robots.recording.file import Pictures, Recorder


class FilmedRobot:
    """A robot of one step, which its camera shows in pictures of some width; none for 0. Others show nothing."""

    name, stopped, stopped_by, locked, has_cameras = "arm-1", False, "", "", True

    def __init__(self, width: int, *others: str) -> None:
        self._width, self.cameras = width, ("top", *others)
        self.begun = False

    @contextmanager
    def recorded(self, recorder: Recorder, fps: int, pictures: Pictures | None) -> Iterator[None]:
        recorder.take(self.name, "streamStep", {"observation": {"pan": 0}, "action": {"pan": 0}})
        for _ in range(2 if self._width else 0):
            assert pictures is not None
            pictures("top", np.zeros((48, self._width, 3), dtype=np.uint8), None)
        yield

    def begin(self) -> Any:
        self.begun = True
        return SimpleNamespace(voided=False, running=True, error="")

    def halt(self, reason: str) -> Any:
        return SimpleNamespace(stopped=True)


class ChattyRobot(FilmedRobot):
    """A robot without a camera, whose steps take some space."""

    has_cameras, halted = False, False

    @contextmanager
    def recorded(self, recorder: Recorder, fps: int, pictures: Pictures | None) -> Iterator[None]:
        for row in np.random.default_rng(1).random((1000, 8)).tolist():
            recorder.take(self.name, "streamStep", {"observation": {"pan": 0}, "action": {"pan": 0}, "more": row})
        yield

    def halt(self, reason: str) -> Any:
        self.halted = True
        return super().halt(reason)


@pytest.fixture
def small_files() -> Iterator[None]:
    """No file of this process grows beyond 30 kB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.usefixtures("small_files")
def test_attempt_ends_where_its_recording_cannot_be_written(tmp_path: Path) -> None:
    robot: Any = ChattyRobot(0)
    screen = Screen(console=Console(file=io.StringIO()))
    with RecordingSession(tmp_path, 30, "wave", "so100", lambda said: None) as session:
        with pytest.raises(
            CliError, match=r"cannot be written: File too large\. Episodes that are saved: 0\. The attempt is in"
        ):
            record_attempts(screen, robot, session, Attempts(1, robot.begin, 30, 600.0, 0.0, success=True))
        assert robot.halted
        assert session.recording.stat().st_size > 10_000, "what was written is still there"


def recorded(robot: Any, folder: Path) -> str:
    """Record an attempt of it, and return why that failed."""
    screen = Screen(console=Console(file=io.StringIO()))
    with (
        RecordingSession(folder, 30, "wave", "so100", lambda said: None) as session,
        pytest.raises(CliError) as failed,
    ):
        record_attempts(screen, robot, session, Attempts(1, robot.begin, 30, 20.0, 0.0, success=True))
    assert not (folder / "meta").exists()
    return str(failed.value)


def test_camera_whose_pictures_cannot_be_encoded_ends_the_attempt_by_name(tmp_path: Path) -> None:
    why = recorded(FilmedRobot(63), tmp_path)
    assert "The attempt failed: camera top: width must be even, not 63" in why
    assert "No episode: the attempt has no picture of top" in why
    assert (tmp_path / ".running" / "aside-000000.mcap").exists()


@pytest.mark.parametrize(
    ("robot", "silent"), [(FilmedRobot(0), "top"), (FilmedRobot(64, "wrist", "side"), "wrist, side")]
)
def test_nothing_is_led_where_a_camera_does_not_deliver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: FilmedRobot, silent: str
) -> None:
    monkeypatch.setattr(dataset_recording, "FIRST_PICTURE_S", 0.05)
    assert f"No picture of {silent} came within 0.05 s" in recorded(robot, tmp_path)
    assert not robot.begun


def test_camera_that_is_asked_for_and_not_there_is_waited_for_by_name() -> None:
    led: Any = None
    frames = {"top": None, "arm.wrist": None}
    driver = Driver(lambda: None, ExitStack())
    assert LocalAttempts(led, lambda: frames, driver).cameras == ["top", "arm.wrist"]
    assert LocalAttempts(led, lambda: frames, driver, ["arm/wrist", "side"]).cameras == ["top", "arm.wrist", "side"]
