"""Every built-in robot and driver has a row in the README, at gold or better."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from fixtures.conformance_table import BUILT_INS, ROOT, TIER, rows

from strands_robots.drivers import ros
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.robot import PLUG_INS
from strands_robots.testing import BusRecorder, Tier, promises
from strands_robots.testing.built_in import built_in
from strands_robots.utils import ValidationError


def named_in_the_table() -> str:
    return " ".join(each.robot for each in rows())


@pytest.mark.parametrize("name", sorted(PLUG_INS.built_in))
def test_each_robot_that_the_factory_makes_has_a_row(name: str) -> None:
    assert f"`{name}`" in named_in_the_table()


def test_each_driver_has_a_row() -> None:
    for module in sorted(Path(ros.__file__).parent.glob("[!_]*.py")):
        import_module(f"{ros.__name__}.{module.stem}")
    bases = [MobileBaseRobot, *MobileBaseRobot.__subclasses__()]
    bases += [each for base in bases for each in base.__subclasses__()]
    drivers = {each.__name__ for each in bases if each.__module__.startswith(ros.__name__)} - {"PosedBaseRobot"}
    assert len(drivers) == 5
    assert not [each for each in (*drivers, "Simulation", "HardwareRobot") if each not in named_in_the_table()]


@pytest.mark.parametrize("robot", BUILT_INS, ids=lambda robot: robot.target)
def test_each_row_is_gold_and_counts_every_check(robot: Any) -> None:
    cells = [each.strip() for each in rows()[robot].strip("|").split("|")]
    assert Tier[cells[2].upper()].value >= Tier[TIER.upper()].value
    exempt = cells[3].count("exempt `")
    assert f"{len(promises(Tier[cells[2].upper()])) - exempt} passed" in cells[3], "make conform writes it anew"


def test_an_arm_is_checked_on_emulated_servos_unless_it_is_said_to_be_real() -> None:
    assert built_in("so101_follower").recorder is not None
    with pytest.raises(ValidationError, match="port is that of a real arm"):
        built_in("so101_follower", port="/dev/ttyACM0")
    assert built_in("so101_follower", mode="real", port="/dev/ttyACM0").recorder is None


def test_a_write_that_no_fault_keeps_from_its_place_is_recorded_in_one() -> None:
    recorder = BusRecorder()
    with recorder.raising(OSError("out")):
        with pytest.raises(OSError, match="out"):
            recorder.wrote("goal")
        recorder.wrote("freeze", can_fail=False)
    assert [each.what for each in recorder.since(0)] == ["freeze"]


def test_conform_names_the_targets_as_the_makefile_runs_them() -> None:
    assert "scripts/conform.py" in (ROOT / "Makefile").read_text(encoding="utf-8")
