"""The way of ``execute`` to the device of a real arm, hop by hop, is the one in docs/architecture.md."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from fixtures.call_path import documented

ROOT = Path(__file__).parents[3]
MESH_FUNCTIONS_MAX = 120


def test_execute_takes_the_documented_way_of_at_most_ten_hops_and_ninety_functions() -> None:
    may = {"DEVICE_CONNECT_RPC_ALLOW": "*", "BYPASS_TOOL_CONSENT": "true", "STRANDS_ALLOW_MOCK": "true"}
    traced = [sys.executable, "-m", "fixtures.traced_execute"]
    told = subprocess.run(
        traced, cwd=ROOT, env={**os.environ, **may}, capture_output=True, text=True, timeout=100, check=False
    )
    assert told.returncode == 0, told.stderr
    lines = told.stdout.splitlines()
    way, entered = ([line.strip() for line in lines if line.startswith(" ") is inner] for inner in (False, True))
    assert way == documented(ROOT / "docs" / "architecture.md", "command-path")
    assert way.count("hand-over") == 2
    assert len(way) - 2 <= 10
    assert len(entered) <= 90, "\n".join(entered)


def test_execute_over_the_mesh_takes_no_longer_way(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    settings = {"BYPASS_TOOL_CONSENT": "true", "STRANDS_ALLOW_MOCK": "true", "STRANDS_STATE_DIR": str(state)}
    traced = [sys.executable, "-m", "fixtures.mesh_call_path"]
    told = subprocess.run(
        traced, cwd=ROOT, env={**os.environ, **settings}, capture_output=True, text=True, timeout=100, check=False
    )
    assert told.returncode == 0, told.stderr
    way, entered = (block.split() for block in told.stdout.split("\n\n"))
    assert way == documented(ROOT / "docs" / "architecture.md", "mesh-command-path")
    assert way.count("hand-over") == 2
    assert len(way) - 2 <= 10
    # A sender proves itself by a signature, which is checked here; Device Connect's caller by its name.
    assert len(entered) <= MESH_FUNCTIONS_MAX, "\n".join(entered)
