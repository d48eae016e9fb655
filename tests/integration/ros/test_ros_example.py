from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from strands_robots import settings

ROOT = Path(__file__).resolve().parents[3]


def run(name: str, tmp_path: Path) -> str:
    ours = {setting.name for setting in settings.declared()}
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    done = subprocess.run(
        [sys.executable, "-m", f"examples.{name}"],
        env={**kept, "STRANDS_STATE_DIR": str(tmp_path), "STRANDS_HALT_DEADLINE_S": "4"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_example_drives_and_stops_every_robot(tmp_path: Path) -> None:
    said = run("ros_bases", tmp_path)
    for name in ("rover", "racer", "base"):
        assert f"{name}: Stopped drive." in said


def test_the_example_navigates_and_is_stopped_on_its_way(tmp_path: Path) -> None:
    said = run("ros_navigate", tmp_path)
    assert "Arrived at x 0.3 m, y 0.4 m in map." in said
    assert "Stopped navigation." in said
    assert "The goal was canceled after a stop ended it." in said


def test_the_example_drives_an_arm_over_rclpy_and_dds_and_shows_a_picture(tmp_path: Path) -> None:
    said = run("ros_arm", tmp_path)
    for bridge in ("HardwareRtpsBridge: commanded 0.5", "HardwareRosBridge: commanded -0.5", "SimRosBridge: a picture"):
        assert bridge in said
