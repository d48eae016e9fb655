"""Recordings: every event kept in its order, a cut file read to the cut, actions as frames that lead."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from fixtures.waiting import eventually

from strands_robots.recording import (
    CHUNK_BYTES,
    Joints,
    Picture,
    Recorder,
    file,
    read_entries,
    read_items,
    recorded_actions,
)
from strands_robots.utils import ValidationError

pytest.importorskip("mcap")


def recorded(path: Path, count: int, *devices: str) -> Path:
    with Recorder(path) as recorder:
        for step in range(count):
            for device in devices:
                recorder.take(
                    device, "streamStep", {"step": step, "action": {"pan.pos": float(step)}, "note": "x" * 50}
                )
    assert recorder.lost == 0
    return path


def test_every_event_is_kept_in_its_order(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 2000, "arm-1", "arm-2")
    entries = list(read_entries(path))
    assert [entry.payload["step"] for entry in entries if entry.device == "arm-1"] == list(range(2000))
    assert {(entry.device, entry.event) for entry in entries} == {("arm-1", "streamStep"), ("arm-2", "streamStep")}
    assert [entry.at for entry in entries] == sorted(entry.at for entry in entries)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_file_that_was_cut_off_is_read_to_the_cut(tmp_path: Path, share: float) -> None:
    path = recorded(tmp_path / "run.mcap", 3000, "arm-1")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    steps = [entry.payload["step"] for entry in read_entries(path)]
    assert steps == list(range(len(steps)))
    assert len(steps) > 3000 * share - 2 * CHUNK_BYTES / 100 - 600
    assert recorded_actions(path)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_pictures_and_joints_of_a_file_that_was_cut_off_are_whole_to_the_cut(tmp_path: Path, share: float) -> None:
    path = tmp_path / "run.mcap"
    pictures = [random.Random(number).randbytes(6000) for number in range(60)]
    with Recorder(path) as recorder:
        for number, picture in enumerate(pictures):
            recorder.take_joints("arm-1", {"pan": float(number)})
            recorder.take_picture("arm-1", "front", picture)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    items = list(read_items(path))
    kept = [item.jpeg for item in items if isinstance(item, Picture)]
    joints = [item.joints for item in items if isinstance(item, Joints)]
    assert kept == pictures[: len(kept)]
    assert len(kept) > 60 * share - 2 * CHUNK_BYTES / 6000 - 2
    assert joints == [{"pan": float(number)} for number in range(len(joints))]
    assert len(joints) >= len(kept)


def test_joints_of_events_are_joint_states_and_what_happened_is_a_log_line(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.take("arm-1", "streamStep", {"observation": {"pan.pos": 1.0, "name": "x"}, "action": {}})
        recorder.take("sim-1", "observationUpdate", {"robot_name": "left", "joints": {"pan": 2.0}})
        recorder.take("arm-1", "taskComplete", {"state": "error", "error": "no bus"})
    assert [(item.device, item.joints) for item in read_items(path) if isinstance(item, Joints)] == [
        ("arm-1", {"pan.pos": 1.0}),
        ("sim-1/left", {"pan": 2.0}),
    ]
    assert recorder.counts["/arm-1/log"] == 1
    assert set(recorder.counts) == {
        "/arm-1/streamStep",
        "/arm-1/joint_states",
        "/sim-1/observationUpdate",
        "/sim-1/left/joint_states",
        "/arm-1/taskComplete",
        "/arm-1/log",
    }


def test_actions_lead_and_a_device_is_named_where_there_are_several(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 10, "arm-1", "arm-2")
    frames = recorded_actions(path, "arm-2")
    assert frames[0][0] == 0.0
    assert [action["pan.pos"] for _, action in frames][-1] == 9.0
    with pytest.raises(ValidationError, match="arm-1, arm-2"):
        recorded_actions(path)
    with pytest.raises(ValidationError, match="arm-3"):
        recorded_actions(path, "arm-3")


def test_an_arm_that_was_moved_by_hand_leads_with_its_joints(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for step in range(5):
            recorder.take_joints("arm-1", {"pan.pos": float(step)})
            recorder.take_joints("arm-2", {"pan.pos": 7.0})
        recorder.take("arm-2", "streamStep", {"step": 0, "action": {"pan.pos": 9.0}})
    assert [action["pan.pos"] for _, action in recorded_actions(path, "arm-1")] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert [action["pan.pos"] for _, action in recorded_actions(path)] == [9.0], "who was driven comes first"
    with Recorder(tmp_path / "none.mcap") as recorder:
        recorder.take("arm-1", "taskStarted", {})
    with pytest.raises(ValidationError, match="nothing in it can lead"):
        recorded_actions(tmp_path / "none.mcap")


def test_a_recording_is_never_overwritten_and_other_files_are_refused(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", 1, "arm-1")
    with pytest.raises(ValidationError, match="there already"):
        Recorder(path)
    with pytest.raises(ValidationError, match=r"\.mcap"):
        Recorder(tmp_path / "run.csv")
    (tmp_path / "text.mcap").write_text("no recording at all, only words", encoding="utf-8")
    with pytest.raises(ValidationError, match="no recording"):
        list(read_entries(tmp_path / "text.mcap"))
    with pytest.raises(ValidationError, match="cannot be written"), Recorder(tmp_path / "none" / "run.mcap"):
        pass
    with pytest.raises(ValidationError, match="cannot be read"):
        list(read_entries(tmp_path / "none.mcap"))


def there(path: Path, event: str) -> bool:
    return any(entry.event == event for entry in read_entries(path))


def test_what_happened_is_in_the_file_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "CHUNK_S", 60.0)
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.take("arm-1", "taskStarted", {})
        eventually(lambda: there(path, "taskStarted"), what="the event, long before its chunk is full or old")


def test_what_comes_at_a_steady_rate_is_in_the_file_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "CHUNK_S", 0.2)
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.take("arm-1", "stateUpdate", {"task_status": "running"})
        eventually(lambda: there(path, "stateUpdate"), what="the state, though nothing comes after it")
        recorder.take_joints("arm-1", {"pan.pos": 1.0})
    assert [entry.event for entry in read_entries(path)] == ["stateUpdate"]
    assert [item.joints for item in read_items(path) if isinstance(item, Joints)] == [{"pan.pos": 1.0}]
