"""The programs of docs/python.md and of docs/control.md, as they stand there."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import free_port

from strands_robots import Robot
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> Iterator[Any]:
    """A simulated arm that a page's programs reach as ``arm-1``."""
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    monkeypatch.setenv("STRANDS_MESH", "false")
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "strands-robots")
    arm = Robot("so100")
    runtime = init_device_connect_sync(arm, peer_id="arm-1", link=loopback_config())
    yield arm
    stop_device_connect(runtime)
    arm.cleanup()


def test_programs_of_the_page_run(arm: Any) -> None:
    drive, stop = _programs("python.md")
    driven, stopped = _ran(drive), _ran(stop)
    assert "True {}" in driven
    assert "The one robot of the roster" in driven
    assert stopped.startswith("True ()\nTrue\n")
    assert "a hand in the cell" in stopped


def test_program_that_leads_a_robot_from_elsewhere_moves_it(arm: Any) -> None:
    (lead,) = _programs("control.md")
    before = arm.get_state()["robots"]["so100"]["shoulder_pan"]
    _ran(lead)
    assert arm.get_state()["robots"]["so100"]["shoulder_pan"] - before == pytest.approx(0.2, abs=0.05)


def _programs(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def _ran(program: str) -> str:
    line = [sys.executable, "-W", "error::DeprecationWarning", "-c", program]
    run = subprocess.run(line, capture_output=True, text=True, timeout=120.0, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout
