"""Leaders without an arm of their own: a recorded file, a keyboard, a gamepad."""

from __future__ import annotations

from strands_robots.leaders.bounded import BoundedLeader
from strands_robots.leaders.dataset import read_episode
from strands_robots.leaders.gamepad import GamepadLeader
from strands_robots.leaders.keyboard import KeyboardLeader
from strands_robots.leaders.recorded import RecordedLeader, read_frames, write_csv

__all__ = [
    "BoundedLeader",
    "GamepadLeader",
    "KeyboardLeader",
    "RecordedLeader",
    "read_episode",
    "read_frames",
    "write_csv",
]
