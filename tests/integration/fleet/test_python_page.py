"""The programs of docs/python.md, as they stand there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.waiting import free_port

from strands_robots import Robot
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect

PAGE = Path(__file__).parents[3] / "docs" / "python.md"


def test_programs_of_the_page_run(monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> None:
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    monkeypatch.setenv("STRANDS_MESH", "false")
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "strands-robots")
    drive, stop = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    arm = Robot("so100")
    runtime = init_device_connect_sync(arm, peer_id="arm-1", link=loopback_config())
    try:
        driven, stopped = _ran(drive), _ran(stop)
    finally:
        stop_device_connect(runtime)
        arm.cleanup()
    assert "True {}" in driven
    assert "The one robot of the roster" in driven
    assert stopped.startswith("True ()\nTrue\n")
    assert "a hand in the cell" in stopped


def _ran(program: str) -> str:
    line = [sys.executable, "-W", "error::DeprecationWarning", "-c", program]
    run = subprocess.run(line, capture_output=True, text=True, timeout=120.0, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout
