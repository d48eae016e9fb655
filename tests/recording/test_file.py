"""Recording files: order of events, cut files, actions as frames for a leader."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from fixtures.waiting import eventually

from strands_robots.recording import file
from strands_robots.recording.file import (
    CHUNK_BYTES,
    RecordedJoints,
    RecordedPicture,
    Recorder,
    read_events,
    read_items,
    recorded_actions,
)
from strands_robots.utils import ValidationError

pytest.importorskip("mcap")


def record_steps(path: Path, count: int, *devices: str) -> Path:
    with Recorder(path) as recorder:
        for step in range(count):
            for device in devices:
                recorder.take(
                    device, "streamStep", {"step": step, "action": {"pan.pos": float(step)}, "note": "x" * 50}
                )
    assert recorder.lost == 0
    return path


def test_events_are_read_in_the_order_of_writing(tmp_path: Path) -> None:
    path = record_steps(tmp_path / "run.mcap", 2000, "arm-1", "arm-2")
    events = list(read_events(path))
    assert [event.payload["step"] for event in events if event.device == "arm-1"] == list(range(2000))
    assert {(event.device, event.event) for event in events} == {("arm-1", "streamStep"), ("arm-2", "streamStep")}
    assert [event.at for event in events] == sorted(event.at for event in events)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_cut_file_is_read_up_to_the_cut(tmp_path: Path, share: float) -> None:
    path = record_steps(tmp_path / "run.mcap", 3000, "arm-1")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    steps = [event.payload["step"] for event in read_events(path)]
    assert steps == list(range(len(steps)))
    assert len(steps) > 3000 * share - 2 * CHUNK_BYTES / 100 - 600
    assert recorded_actions(path)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_cut_file_has_whole_pictures_and_joints_up_to_the_cut(tmp_path: Path, share: float) -> None:
    path = tmp_path / "run.mcap"
    pictures = [random.Random(number).randbytes(6000) for number in range(60)]
    with Recorder(path) as recorder:
        for number, picture in enumerate(pictures):
            recorder.take_joints("arm-1", {"pan": float(number)})
            recorder.take_picture("arm-1", "front", picture)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    items = list(read_items(path))
    jpegs = [item.jpeg for item in items if isinstance(item, RecordedPicture)]
    joints = [item.joints for item in items if isinstance(item, RecordedJoints)]
    assert jpegs == pictures[: len(jpegs)]
    assert len(jpegs) > 60 * share - 2 * CHUNK_BYTES / 6000 - 2
    assert joints == [{"pan": float(number)} for number in range(len(joints))]
    assert len(joints) >= len(jpegs)


def test_joints_of_events_become_joint_states_and_task_events_log_lines(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.take("arm-1", "streamStep", {"observation": {"pan.pos": 1.0, "name": "x"}, "action": {}})
        recorder.take("sim-1", "observationUpdate", {"robot_name": "left", "joints": {"pan": 2.0}})
        recorder.take("arm-1", "taskComplete", {"state": "error", "error": "no bus"})
    assert [(item.device, item.joints) for item in read_items(path) if isinstance(item, RecordedJoints)] == [
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


def test_recorded_actions_need_a_device_where_there_are_several(tmp_path: Path) -> None:
    path = record_steps(tmp_path / "run.mcap", 10, "arm-1", "arm-2")
    frames = recorded_actions(path, "arm-2")
    assert frames[0][0] == 0.0
    assert [action["pan.pos"] for _, action in frames][-1] == 9.0
    with pytest.raises(ValidationError, match="arm-1, arm-2"):
        recorded_actions(path)
    with pytest.raises(ValidationError, match="arm-3"):
        recorded_actions(path, "arm-3")


def test_recorded_actions_of_an_arm_moved_by_hand_are_its_joints(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for step in range(5):
            recorder.take_joints("arm-1", {"pan.pos": float(step)})
            recorder.take_joints("arm-2", {"pan.pos": 7.0})
        recorder.take("arm-2", "streamStep", {"step": 0, "action": {"pan.pos": 9.0}})
    assert [action["pan.pos"] for _, action in recorded_actions(path, "arm-1")] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert [action["pan.pos"] for _, action in recorded_actions(path)] == [9.0], "the driven device comes first"
    with Recorder(tmp_path / "none.mcap") as recorder:
        recorder.take("arm-1", "taskStarted", {})
    with pytest.raises(ValidationError, match="nothing in it can lead"):
        recorded_actions(tmp_path / "none.mcap")


def test_existing_and_unreadable_files_are_refused(tmp_path: Path) -> None:
    path = record_steps(tmp_path / "run.mcap", 1, "arm-1")
    with pytest.raises(ValidationError, match="there already"):
        Recorder(path)
    with pytest.raises(ValidationError, match=r"\.mcap"):
        Recorder(tmp_path / "run.csv")
    (tmp_path / "text.mcap").write_text("no recording at all, only words", encoding="utf-8")
    with pytest.raises(ValidationError, match="no recording"):
        list(read_events(tmp_path / "text.mcap"))
    with pytest.raises(ValidationError, match="cannot be written"), Recorder(tmp_path / "none" / "run.mcap"):
        pass
    with pytest.raises(ValidationError, match="cannot be read"):
        list(read_events(tmp_path / "none.mcap"))


def contains(path: Path, name: str) -> bool:
    return any(event.event == name for event in read_events(path))


def test_task_event_is_in_the_file_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "CHUNK_S", 60.0)
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.take("arm-1", "taskStarted", {})
        eventually(lambda: contains(path, "taskStarted"), what="the event, long before its chunk is full or old")


def test_steady_event_is_in_the_file_within_the_chunk_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file, "CHUNK_S", 0.2)
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.take("arm-1", "stateUpdate", {"task_status": "running"})
        eventually(lambda: contains(path, "stateUpdate"), what="the state, although nothing follows it")
        recorder.take_joints("arm-1", {"pan.pos": 1.0})
    assert [event.event for event in read_events(path)] == ["stateUpdate"]
    assert [item.joints for item in read_items(path) if isinstance(item, RecordedJoints)] == [{"pan.pos": 1.0}]
