"""Keyboard and gamepad leaders."""

from __future__ import annotations

import os
import pty
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.waiting import eventually

from strands_robots.teleoperators import GamepadLeader, KeyboardLeader, LeaderFinished
from strands_robots.utils import ValidationError

START = {"pan.pos": 0.0, "grip.pos": 50.0}
RANGES = {"pan.pos": (-100.0, 100.0), "grip.pos": (0.0, 100.0)}


class Watch:
    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    person, program = pty.openpty()
    yield person, program
    os.close(person)
    os.close(program)


def test_keys_push_joints_inside_their_ranges_and_escape_ends_the_leader(terminal: tuple[int, int]) -> None:
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


def test_keyboard_needs_a_terminal_and_at_most_ten_joints(terminal: tuple[int, int], tmp_path: Path) -> None:
    with (tmp_path / "file").open("w") as file, pytest.raises(ValidationError, match="terminal"):
        KeyboardLeader(START, RANGES, file.fileno())
    with pytest.raises(ValidationError, match="at most 10"):
        KeyboardLeader(dict.fromkeys(map(str, range(11)), 0.0), {}, terminal[1])
    with pytest.raises(ValidationError, match="at least one"):
        KeyboardLeader({}, {}, terminal[1])


def event(value: int, kind: int, number: int) -> bytes:
    return struct.pack("<IhBB", 0, value, kind, number)


def test_sticks_push_joints_and_button_1_ends_the_leader(tmp_path: Path) -> None:
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
        assert leader.get_action()["pan.pos"] == pytest.approx(6.0), "a pause does not add up"
        pad.write(event(1, 1, 1))
        with pytest.raises(LeaderFinished):
            leader.get_action()
        assert leader.get_teleop_events() == {"button_1": True}
    with pytest.raises(ValidationError, match="cannot be opened"):
        GamepadLeader(START, RANGES, str(tmp_path / "none"))
