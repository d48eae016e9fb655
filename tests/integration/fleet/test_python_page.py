"""The program of docs/python.md, as it stands there."""

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


def test_program_of_the_page_runs(monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> None:
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    monkeypatch.setenv("STRANDS_MESH", "false")
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    arm = Robot("so100")
    runtime = init_device_connect_sync(arm, peer_id="arm-1", link=loopback_config())
    try:
        line = [sys.executable, "-W", "error::DeprecationWarning", "-c", program]
        run = subprocess.run(line, capture_output=True, text=True, timeout=120.0, check=False)
    finally:
        stop_device_connect(runtime)
        arm.cleanup()
    assert run.returncode == 0, run.stderr
    assert "True {}" in run.stdout
    assert "'arm-1': StopVerdict(" in run.stdout
