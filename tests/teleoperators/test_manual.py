"""Leaders that a machine without a leader arm has: a file, a keyboard, a gamepad."""

from __future__ import annotations

import os
import pty
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.teleoperators.leader import LeaderFinished
from strands_robots.teleoperators.manual import GamepadLeader, KeyboardLeader
from strands_robots.teleoperators.recorded import RecordedLeader, read_frames, write_csv
from strands_robots.utils import ValidationError

START = {"pan.pos": 0.0, "grip.pos": 50.0}
RANGES = {"pan.pos": (-100.0, 100.0), "grip.pos": (0.0, 100.0)}


class Watch:
    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def test_a_recording_is_played_at_its_own_times_and_ends() -> None:
    watch = Watch()
    leader = RecordedLeader([(5.0, {"a": 0.0, "b": 1.0}), (6.0, {"a": 10.0}), (8.0, {"b": 3.0})], now=watch)
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
    assert (leader.duration, leader.position, leader.keys) == (3.0, 3.0, ("a", "b"))


def test_a_recording_can_be_played_faster() -> None:
    watch = Watch()
    leader = RecordedLeader([(0.0, {"a": 0.0}), (2.0, {"a": 10.0})], speed=2, now=watch)
    leader.get_action()
    watch.seconds += 0.5
    assert leader.get_action() == {"a": 5.0}
    assert leader.duration == 1.0


def test_frames_survive_the_file(tmp_path: Path) -> None:
    frames = [(0.0, {"a.pos": 1.0}), (0.02, {"a.pos": 2.5, "b.pos": -3.0})]
    write_csv(tmp_path / "run.csv", frames)
    assert read_frames(tmp_path / "run.csv") == frames


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "first line"),
        ("a,b\n1,2\n", "first line"),
        ("t,a,a\n0,1,2\n", "first line"),
        ("t,a\n0,1\n1\n", "line 3 of run.csv must have 2 cells"),
        ("t,a\n0,x\n", "a in line 2 of run.csv must be a number"),
        ("t,a\nnan,1\n", "t in line 2"),
    ],
)
def test_a_broken_file_is_refused_by_its_line(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ValidationError, match=words):
        read_frames(path)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path / "run.txt"):
        with pytest.raises(ValidationError, match="recording"):
            read_frames(path)
    for frames in ([], [(1.0, {"a": 1.0}), (1.0, {"a": 2.0})]):
        with pytest.raises(ValidationError, match="frames"):
            RecordedLeader(frames)


def test_a_finished_recording_completes_the_teleoperation_and_the_follower_holds() -> None:
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


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    person, program = pty.openpty()
    yield person, program
    os.close(person)
    os.close(program)


def test_keys_push_joints_inside_their_ranges_and_escape_ends(terminal: tuple[int, int]) -> None:
    person, program = terminal
    with KeyboardLeader(START, RANGES, program) as leader:
        assert leader.is_connected
        assert leader.help == [("pan.pos", "q", "a"), ("grip.pos", "w", "s")]
        assert leader.get_action() == START
        os.write(person, b"qqSx")
        eventually(lambda: leader.get_action() == {"pan.pos": 10.0, "grip.pos": 47.5})
        os.write(person, b"s" * 60)
        eventually(lambda: leader.get_action()["grip.pos"] == 0.0)
        os.write(person, b"\x1b")
        with pytest.raises(LeaderFinished):
            eventually(lambda: leader.get_action() is None)
    assert not leader.is_connected


def test_a_keyboard_needs_a_terminal_and_at_most_ten_joints(terminal: tuple[int, int], tmp_path: Path) -> None:
    with (tmp_path / "file").open("w") as file, pytest.raises(ValidationError, match="terminal"):
        KeyboardLeader(START, RANGES, file.fileno())
    with pytest.raises(ValidationError, match="at most 10"):
        KeyboardLeader(dict.fromkeys(map(str, range(11)), 0.0), {}, terminal[1])
    with pytest.raises(ValidationError, match="at least one"):
        KeyboardLeader({}, {}, terminal[1])


def event(value: int, kind: int, number: int) -> bytes:
    return struct.pack("<IhBB", 0, value, kind, number)


def test_sticks_push_joints_and_a_button_ends(tmp_path: Path) -> None:
    device = tmp_path / "js0"
    os.mkfifo(device)
    watch = Watch()
    with GamepadLeader(START, RANGES, str(device), watch) as leader, device.open("wb", buffering=0) as pad:
        pad.write(event(0, 0x82, 0) + event(0, 0x81, 1))
        assert leader.get_action() == START
        pad.write(event(32767, 2, 0) + event(-1000, 2, 1))
        leader.get_action()
        watch.seconds += 0.02
        assert leader.get_action() == {"pan.pos": pytest.approx(1.0 + 0.0), "grip.pos": 50.0}
        watch.seconds += 60
        assert leader.get_action()["pan.pos"] == pytest.approx(6.0), "a pause is not saved up"
        pad.write(event(1, 1, 1))
        with pytest.raises(LeaderFinished):
            leader.get_action()
        assert leader.get_teleop_events() == {"button_1": True}
    with pytest.raises(ValidationError, match="cannot be opened"):
        GamepadLeader(START, RANGES, str(tmp_path / "none"))
