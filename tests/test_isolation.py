"""No test meets what the user of this machine has set or kept, nor does what a whole file shares."""

from __future__ import annotations

from pathlib import Path

import pytest

from strands_robots import settings
from strands_robots.safety.approval import state_dir

KEPT = Path("~/.strands_robots").expanduser()


@pytest.fixture(scope="module")
def shared() -> Path:
    return state_dir()


def test_a_robot_of_a_whole_file_keeps_its_state_away_from_the_users(shared: Path) -> None:
    assert shared != KEPT
    assert shared != state_dir()
    assert state_dir() != KEPT


def test_no_setting_of_the_shell_is_left() -> None:
    left = {setting.name for setting in settings.declared() if settings.is_set(setting.name)}
    assert left <= {"STRANDS_STATE_DIR", "DISPLAY", "MUJOCO_GL"}
