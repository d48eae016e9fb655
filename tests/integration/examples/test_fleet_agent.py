"""The example of an agent's CI runs as a stranger runs it: with pytest and the installed plug-in."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from fixtures.child_pytest import ROOT, child_pytest

pytestmark = pytest.mark.system


def test_example_passes_in_a_folder_without_a_conftest(tmp_path: Path) -> None:
    run = child_pytest(Path(shutil.copy(ROOT / "examples" / "test_fleet_agent.py", tmp_path)))
    assert run.code == 0, run.said
    assert set(run.results.values()) == {"passed"}
    assert len(run.results) == 2
