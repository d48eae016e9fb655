"""Packages of other people from the index, graded anew: one on Feetech's servos, one on Dynamixel's."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fixtures.foreign_robots.catalogue import ROBOTS
from fixtures.foreign_robots.table import ROOT, results

from strands_robots.testing import Tier

pytestmark = pytest.mark.system

AGAIN = ("lerobot-robot-so101-paxini", "lerobot-robot-ghand")


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    return importlib.import_module("foreign")


@pytest.mark.parametrize("package", AGAIN)
def test_foreign_package_has_silver_as_the_page_says(package: str, script: Any, tmp_path: Path) -> None:
    robot = next(each for each in ROBOTS if each.package == package)
    try:
        script.install(robot, Path(sys.executable), tmp_path)
    except subprocess.CalledProcessError as problem:
        why = f"{package} cannot be installed from the package index: {problem.stderr[-300:]}"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    facts = script.grade(robot, Path(sys.executable), tmp_path, "silver")
    assert not facts["failed"], facts
    assert Tier[facts["tier"].upper()].value >= Tier.SILVER.value
    assert Tier[results()[package]["tier"].upper()].value >= Tier.SILVER.value
