"""LeRobot's own driver on emulated servos keeps the promises that robots of others are held to."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from fixtures.conformance_table import BUILT_INS, ROOT, TIER, rows

pytestmark = pytest.mark.system


@pytest.mark.timeout(180)
def test_the_row_of_a_real_arm_in_the_readme_is_what_a_run_says() -> None:
    robot = next(each for each in BUILT_INS if each.target == "so101_follower")
    # In a process whose driver waits as LeRobot's does, and not as that of the tests here.
    command = [sys.executable, "-m", "strands_robots.cli", "conform", robot.target, "--tier", TIER, "--json"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=150)
    report = next(each for each in map(json.loads, ran.stdout.splitlines()) if each.get("event") == "report")
    assert robot.row(report) == rows()[robot]
