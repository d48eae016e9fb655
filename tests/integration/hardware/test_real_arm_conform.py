"""``conform`` of a real arm: LeRobot's driver on emulated servos moves once its list is approved, as hardware does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fixtures.command_line import Machine

from strands_robots.hardware.emulated import emulated_arm

pytestmark = pytest.mark.system


def test_arm_that_is_approved_is_stopped_and_no_stop_is_proven(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")
    machine.forked = False
    with emulated_arm() as options:
        sets = [word for name, value in options.items() for word in ("--set", f"{name}={value}")]
        motion = ("--motion", "execute instruction=wave policy_provider=mock duration=4")
        line = (
            "conform",
            "so101",
            "--set",
            "mode=real",
            *sets,
            *motion,
            "--only",
            "silver.halts",
            "--only",
            "silver.honest",
        )
        listed = json.loads(machine.run(*line, "--json").stdout.splitlines()[0])
        assert options["port"] in listed["motions"][0]
        code, report = machine.last_json(*line, "--approve-motions", listed["digest"])
    halts, honest = report["checks"]
    assert (code, halts["mark"], honest["mark"]) == (0, "not proven", "not proven")
    assert "the network says: verdict stopped" in halts["said"]
    assert "joints moved" in halts["said"]
