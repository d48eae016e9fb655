"""A recorder that is killed at any moment costs no episode that it said to be saved."""

from __future__ import annotations

from pathlib import Path

from fixtures.killed_recorders import killed_while_saving

KILLS = 12


def test_saved_episodes_outlive_a_recorder_that_is_killed(tmp_path: Path) -> None:
    assert killed_while_saving(tmp_path, KILLS) >= KILLS
