"""Sessions of recording: what is kept is saved once, and a killed session goes on where it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from strands_robots.datasets import DatasetError, tables
from strands_robots.datasets.layout import data_file, read_info
from strands_robots.datasets.session import RecordingSession
from strands_robots.recording.file import Recorder
from strands_robots.utils import ValidationError

FPS = 20


def attempt(path: Path, steps: int = 20, *, joint: str = "pan") -> None:
    """Record the steps of a led arm, as a session that was killed leaves them: without an end."""
    with Recorder(path) as recorder:
        recorder.take("arm-1", "taskStarted", {"instruction": "follow leader"}, 1000.0)
        for step in range(steps):
            payload = {"observation": {joint: float(step)}, "action": {joint: float(step)}}
            recorder.take("arm-1", "streamStep", payload, 1000.0 + step / FPS)


def session(folder: Path, fps: int = FPS, said: list[str] | None = None) -> RecordingSession:
    return RecordingSession(folder, fps, "put the cube on the plate", "so100", ([] if said is None else said).append)


def test_kept_attempts_are_episodes(tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        for number, success in enumerate((True, False)):
            attempt(recording.recording)
            assert recording.keep(success=success) == (number, 20)
        attempt(recording.recording)
        recording.discard()
        assert recording.episodes == 2
    ends = [tables.read_frames(tmp_path / data_file(number))["next.success"][-1] for number in (0, 1)]
    assert ends == [True, False]
    assert list((tmp_path / ".running").iterdir()) == []


def test_attempt_that_was_running_is_the_first_episode_of_the_next_session(tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        attempt(recording.recording, steps=7)
    said: list[str] = []
    with session(tmp_path, said=said) as again:
        assert again.episodes == 1
    assert said == ["episode 0 is the attempt that was running, cut to its last second: 7 frames."]
    assert not tables.read_frames(tmp_path / data_file(0))["next.success"].any()


def test_attempt_that_was_saved_before_the_kill_is_saved_once(tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        path = recording.recording
        attempt(path)
        content = path.read_bytes()
        recording.keep(success=True)
        path.write_bytes(content)
    with session(tmp_path) as again:
        assert again.episodes == 1
    assert not path.exists()


def test_attempt_without_a_step_is_no_episode(tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        attempt(recording.recording, steps=0)
        assert recording.keep(success=True) is None
        recording.recording.write_bytes(b"")
        assert recording.keep(success=True) is None
    assert not (tmp_path / "meta").exists()


def test_attempt_of_another_robot_is_refused_and_still_there(tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        attempt(recording.recording)
        recording.keep(success=True)
        attempt(recording.recording, joint="lift")
        with pytest.raises(ValidationError, match="has another kind of episodes"):
            recording.keep(success=True)
        assert recording.recording.exists()
    assert read_info(tmp_path).episodes == 1
    told: list[str] = []
    with RecordingSession(tmp_path, 20, "wave", "so100", told.append) as again:
        attempt(again.recording)
        assert again.keep(success=True) is not None, "it is not in the way of the next ones"
    assert "has another kind of episodes" in told[0]
    assert (tmp_path / ".running" / "aside-000000.mcap").exists()


def test_second_session_and_another_rate_are_refused(tmp_path: Path) -> None:
    with session(tmp_path) as recording:
        with pytest.raises(DatasetError, match="recorded into by another process"):
            session(tmp_path)
        attempt(recording.recording)
        recording.keep(success=True)
    with pytest.raises(ValidationError, match="fps must be 20"):
        session(tmp_path, fps=30)
    with session(tmp_path) as again:
        assert again.episodes == 1


def test_session_that_records_nothing_leaves_no_folder(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    with RecordingSession(folder, 30, "wave", "so100", lambda said: None) as session:
        assert session.recording.parent.is_dir()
    assert not folder.exists()
    with RecordingSession(folder, 30, "wave", "so100", lambda said: None) as session:
        session.recording.write_bytes(b"cut off")
    assert session.recording.exists(), "what was recorded is never removed unasked"
    (tmp_path / "there").mkdir()
    with RecordingSession(tmp_path / "there", 30, "wave", "so100", lambda said: None):
        pass
    assert (tmp_path / "there").is_dir()
