"""Recordings as leaders: playback, ``.csv`` files and LeRobot's datasets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import write_csv
from fixtures.waiting import eventually

from strands_robots import teleoperators
from strands_robots.hardware import HardwareRobot
from strands_robots.teleoperators import LeaderFinished, RecordedLeader, read_episode, read_frames
from strands_robots.utils import ValidationError

NAMES = ["pan.pos", "grip.pos"]


class Watch:
    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def test_recording_is_played_at_its_own_times_and_ends() -> None:
    watch = Watch()
    leader = RecordedLeader([(5.0, {"a": 0.0, "b": 1.0}), (6.0, {"a": 10.0}), (8.0, {"b": 3.0})], now=watch)
    assert leader.keys == ("a", "b")
    assert leader.get_action() == {"a": 0.0, "b": 1.0}
    watch.seconds += 0.5
    assert leader.get_action() == {"a": 5.0, "b": 1.0}
    watch.seconds += 1.5
    assert leader.get_action() == {"a": 10.0, "b": 2.0}
    watch.seconds += 1.0
    assert leader.get_action() == {"a": 10.0, "b": 3.0}
    watch.seconds += 0.01
    with pytest.raises(LeaderFinished):
        leader.get_action()


def test_recording_can_be_played_faster() -> None:
    watch = Watch()
    leader = RecordedLeader([(0.0, {"a": 0.0}), (2.0, {"a": 10.0})], speed=2, now=watch)
    leader.get_action()
    watch.seconds += 0.5
    assert leader.get_action() == {"a": 5.0}


def test_frames_survive_a_csv_file(tmp_path: Path) -> None:
    frames = [(0.0, {"a.pos": 1.0}), (0.02, {"a.pos": 2.5, "b.pos": -3.0})]
    write_csv(tmp_path / "run.csv", frames)
    assert read_frames(tmp_path / "run.csv") == frames


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "first line"),
        ("a,b\n1,2\n", "first line"),
        ("t,a,a\n0,1,2\n", "first line"),
        ("t,a\n0,1\n1\n", "line 3 of run.csv must have 2 cells"),
        ("t,a\n0,x\n", "a in line 2 of run.csv must be a number"),
        ("t,a\nnan,1\n", "t in line 2"),
    ],
)
def test_broken_csv_file_is_refused_with_its_line(tmp_path: Path, content: str, problem: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ValidationError, match=problem):
        read_frames(path)


def test_csv_file_beyond_a_bound_is_refused_before_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,a\n" + "0," + "1" * teleoperators.LINE_MAX)
    with pytest.raises(ValidationError, match="65,536 characters"):
        read_frames(path)
    monkeypatch.setattr(teleoperators, "ROWS_MAX", 3)
    path.write_text("t,a\n" + "".join(f"{at},1\n" for at in range(10)))
    with pytest.raises(ValidationError, match="4 rows, and may have 3"):
        read_frames(path)


def test_missing_foreign_and_unordered_recordings_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path / "run.txt"):
        with pytest.raises(ValidationError, match="recording"):
            read_frames(path)
    for frames in ([], [(1.0, {"a": 1.0}), (1.0, {"a": 2.0})]):
        with pytest.raises(ValidationError, match="frames"):
            RecordedLeader(frames)


def test_finished_recording_completes_the_teleoperation_and_the_follower_keeps_its_position() -> None:
    device = RecordingDevice()
    robot = HardwareRobot(device)
    robot.connect()
    watch = Watch()
    robot.attach_teleop(RecordedLeader([(0.0, {"pan.pos": 10.0}), (0.2, {"pan.pos": 20.0})], now=watch), "tape")
    assert robot.teleoperate("tape")["status"] == "success"
    eventually(lambda: device.writes)
    watch.seconds += 0.18
    eventually(lambda: device.positions["pan.pos"] == pytest.approx(19))
    watch.seconds += 0.1
    eventually(lambda: robot.teleop_status()["leaders"]["tape"]["state"] == "completed")
    assert device.positions["pan.pos"] == pytest.approx(19)
    robot.cleanup()


def dataset(folder: Path, names: Any = NAMES, **columns: Any) -> Path:
    """Write two episodes of three frames at 10 Hz in LeRobot's layout."""
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")

    rows = {
        "action": [[float(step), 50.0 + step] for step in range(6)],
        "observation.state": [[0.0, 0.0]] * 6,
        "timestamp": [0.1 * (step % 3) for step in range(6)],
        "frame_index": [step % 3 for step in range(6)],
        "episode_index": [step // 3 for step in range(6)],
    } | columns
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    parquet.write_table(pyarrow.table({name: column for name, column in rows.items() if column is not None}), path)
    (folder / "meta").mkdir()
    info = {"features": {"action": {"dtype": "float32", "shape": [2], "names": names}}}
    (folder / "meta" / "info.json").write_text(json.dumps(info), encoding="utf-8")
    return path


@pytest.mark.parametrize("names", [NAMES, {"motors": NAMES}])
def test_episode_is_read_with_the_names_of_its_dataset(tmp_path: Path, names: Any) -> None:
    path = dataset(tmp_path, names)
    frames = read_episode(path, "1")
    assert [seconds for seconds, _ in frames] == pytest.approx([0.0, 0.1, 0.2])
    assert frames[0][1] == {"pan.pos": 3.0, "grip.pos": 53.0}


def test_file_of_one_episode_needs_no_number(tmp_path: Path) -> None:
    assert len(read_episode(dataset(tmp_path, episode_index=[4] * 6, timestamp=[0.1 * n for n in range(6)]))) == 6


@pytest.mark.parametrize(
    ("columns", "episode", "problem"),
    [
        ({}, None, r"0 to 1"),
        ({}, "7", r"0 to 1"),
        ({"action": None}, "1", "no column action"),
        ({"action": [[1.0]] * 6}, "1", "2 numbers"),
        ({"action": [[1.0, float("nan")]] * 6}, "1", "grip.pos in row 0"),
        ({"names": []}, "1", "list of names"),
    ],
)
def test_unusable_episode_is_refused_with_its_problem(
    tmp_path: Path, columns: dict[str, Any], episode: str | None, problem: str
) -> None:
    with pytest.raises(ValidationError, match=problem):
        read_episode(dataset(tmp_path, **columns), episode)


def test_file_outside_a_dataset_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.parquet"
    text.write_text("only words", encoding="utf-8")
    with pytest.raises(ValidationError, match="no data file"):
        read_episode(text)
    with pytest.raises(ValidationError, match="cannot be read"):
        read_episode(tmp_path / "none.parquet")
    path = dataset(tmp_path / "set")
    (tmp_path / "set" / "meta" / "info.json").unlink()
    with pytest.raises(ValidationError, match=r"meta/info\.json"):
        read_episode(path, "1")
