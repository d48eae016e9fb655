"""Tests see neither the settings nor the state directory of the user, shared fixtures included."""

from __future__ import annotations

from pathlib import Path

import pytest

from strands_robots import settings
from strands_robots.state_files import state_dir

USERS = Path("~/.strands_robots").expanduser()


@pytest.fixture(scope="module")
def shared() -> Path:
    return state_dir()


def test_module_fixture_has_a_state_directory_of_its_own(shared: Path) -> None:
    assert shared != USERS
    assert shared != state_dir()
    assert state_dir() != USERS


def test_settings_of_the_shell_are_removed() -> None:
    left = {setting.name for setting in settings.declared() if settings.is_set(setting.name)}
    assert left <= {"STRANDS_STATE_DIR", "STRANDS_ALLOW_MOCK", "STRANDS_MESH_PORT", "DISPLAY", "MUJOCO_GL"}
