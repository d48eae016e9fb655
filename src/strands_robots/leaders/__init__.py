"""Leaders without an arm of their own: a recorded file, a keyboard, a gamepad."""

from __future__ import annotations

from strands_robots.leaders.gamepad import GamepadLeader
from strands_robots.leaders.keyboard import KeyboardLeader
from strands_robots.leaders.recorded import RecordedLeader, read_frames, write_csv

__all__ = ["GamepadLeader", "KeyboardLeader", "RecordedLeader", "read_frames", "write_csv"]
