"""``conform --live``: a robot of another process, and hardware: no stop of either is proven."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures import faulty_robots
from fixtures.command_line import WITHIN_S, Machine
from fixtures.waiting import eventually

from strands_robots.envelope import success
from strands_robots.testing import CheckMark, LongMotion, conform

BARISTA = Path(__file__).parents[3] / "examples" / "barista.py"
MOTION = "brewCoffee cups=4"
pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A machine on whose networks another process serves the barista."""
    allowed = {"DEVICE_CONNECT_RPC_ALLOW": "strands-robots", "STRANDS_ROBOT_COMMAND_ALLOW": "brewCoffee"}
    machine = Machine(tmp_path_factory.mktemp("state"), STRANDS_MESH="true", **allowed)
    robot = subprocess.Popen(
        [sys.executable, BARISTA],
        env=machine.environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        eventually(lambda: on_both(machine), WITHIN_S, "the barista on both networks")
        yield machine
    finally:
        robot.terminate()
        robot.wait(WITHIN_S)


def on_both(machine: Machine) -> bool:
    peers = machine.json("peers")[1]["peers"]
    return any(each["id"] == "barista" and each["also_on"] for each in peers)


def conformed(machine: Machine, *arguments: str) -> tuple[int, dict[str, dict[str, Any]]]:
    """Return the exit code and the results by check."""
    code, report = machine.last_json("conform", "barista", "--live", *arguments)
    assert "checks" in report, report
    return code, {each["check"]: each for each in report["checks"]}


def beans(machine: Machine) -> float:
    grams = machine.json("call", "barista", "beansLeft")[1]["result"]
    assert isinstance(grams, float)
    return grams


def test_without_a_motion_it_is_read_and_not_moved(machine: Machine) -> None:
    before = beans(machine)
    code, checks = conformed(machine)
    passed = {name for name, each in checks.items() if each["mark"] == "passed"}
    read = {f"bronze.{name}" for name in ("made", "verbs", "schemas", "reads", "status", "features")}
    assert (code, passed) == (0, read | {"gold.own_verbs"})
    assert {each["mark"] for name, each in checks.items() if name not in passed} == {"not proven"}
    assert "no motion is approved" in checks["bronze.domains"]["said"]
    assert beans(machine) == before


def test_motions_that_are_not_approved_are_not_made(machine: Machine) -> None:
    before = beans(machine)
    refused = machine.run("conform", "barista", "--live", "--motion", MOTION, "--json")
    listed, reason = map(json.loads, refused.stdout.splitlines())
    assert refused.returncode == 1
    assert "brewCoffee(cups=4), up to 5 times" in listed["motions"][0]
    assert reason["reason"].endswith(f"--approve-motions {listed['digest']}")
    other = ("--motion", "brewCoffee cups=8", "--approve-motions", listed["digest"])
    assert machine.run("conform", "barista", "--live", *other).returncode == 2
    assert beans(machine) == before


def test_approved_motion_is_stopped_and_no_stop_is_proven(machine: Machine) -> None:
    before = beans(machine)
    listed = json.loads(
        machine.run("conform", "barista", "--live", "--motion", MOTION, "--json").stdout.partition("\n")[0]
    )
    code, checks = conformed(machine, "--motion", MOTION, "--approve-motions", listed["digest"])
    assert code == 0
    assert {each["mark"] for each in checks.values() if each["tier"] == "silver"} == {"not proven"}
    for name in ("halts", "again", "networks"):
        assert "no recorder of its bus; the network says: " in checks[f"silver.{name}"]["said"]
    assert "verdict stopped" in checks["silver.halts"]["said"]
    assert {checks[f"bronze.{name}"]["mark"] for name in ("domains", "unknown")} == {"passed"}
    assert beans(machine) < before


def test_robot_on_one_network_is_not_proven_the_same_on_both(machine: Machine) -> None:
    _, checks = conformed(machine, "--mesh", "--tier", "bronze")
    assert (checks["bronze.reads"]["mark"], checks["bronze.verbs"]["mark"]) == ("passed", "not proven")
    assert "on mesh alone" in checks["bronze.verbs"]["said"]


def test_robot_that_nobody_serves_is_not_in_reach(machine: Machine) -> None:
    code, answer = machine.json("conform", "barman", "--live")
    assert code == 3
    assert "barista" in answer["reason"]


def test_world_of_another_process_is_read_as_one(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "state")
    with machine.serving("arm-1", "--mode", "sim"):
        code, report = machine.last_json("conform", "arm-1", "--live", "--tier", "bronze")
    checks = {each["check"]: (each["mark"], each["said"]) for each in report["checks"]}
    assert code == 0, checks
    assert checks["bronze.status"] == checks["bronze.features"] == ("passed", "a world")


class SaysIdleAndGoesOn(faulty_robots.IgnoresHalt):
    told = False

    def stop_task(self) -> Any:
        self.told = self.told or not self.still.is_set()
        return super().stop_task()

    def get_task_status(self) -> Any:
        return success("idle", task_status="idle") if self.told else super().get_task_status()


@pytest.mark.parametrize(
    ("kind", "said"),
    [(SaysIdleAndGoesOn, "its joints go on after the verdict"), (faulty_robots.RaisesInItsStop, "did not stop")],
)
def test_hardware_that_does_not_stop_fails_by_what_it_says(kind: type[faulty_robots.Rig], said: str) -> None:
    motion = LongMotion("execute", {"instruction": "wave", "policy_provider": "mock", "duration": 2.0})
    rig = replace(faulty_robots.subject(kind), recorder=None, motion=motion)
    _, halts, honest = conform(rig, only=["bronze.status", "silver.halts", "silver.honest"], hardware=True).results
    assert halts.mark is CheckMark.FAILED
    assert said in halts.said
    assert honest.mark is CheckMark.NOT_PROVEN
