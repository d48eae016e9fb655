"""Built-in robots keep the promises that robots of others are held to, and the README says so."""

from __future__ import annotations

import pytest
from fixtures import conformed
from fixtures.conformance_table import BUILT_INS, rows

from strands_robots.testing import Subject, conform
from strands_robots.testing.built_in import built_in

SIMULATED, BASE = "so100", "fixtures.conformed:rosbridge_base"
pytestmark = pytest.mark.system


@pytest.mark.timeout(180)
@pytest.mark.parametrize("target", [SIMULATED, BASE])
def test_the_row_of_a_robot_in_the_readme_is_what_a_run_says(target: str) -> None:
    """``make conform`` runs all; ``test_real_arm_gold.py`` proves a real arm's where LeRobot is."""
    subject: Subject = built_in(target) if target == SIMULATED else conformed.rosbridge_base()
    report = conform(subject)
    robot = next(each for each in BUILT_INS if each.target == target)
    assert robot.row(report.facts()) == rows()[robot], report.words()
