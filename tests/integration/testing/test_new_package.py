"""A package as ``new`` writes it: its tests pass as written, it conforms, and it is served by its name."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.command_line import WITHIN_S, Machine
from fixtures.waiting import eventually

PAGE = (Path(__file__).parents[3] / "docs" / "your-robot.md").read_text("utf-8")
pytestmark = pytest.mark.system


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    """A machine on which the package is installed: its module and its metadata are on the path."""
    made = tmp_path / "my_robot"
    path = os.pathsep.join(filter(None, (str(made / "src"), os.environ.get("PYTHONPATH"))))
    allowed = {"DEVICE_CONNECT_RPC_ALLOW": "*", "STRANDS_ROBOT_COMMAND_ALLOW": "spin"}
    machine = Machine(tmp_path / "state", PYTHONPATH=path, **allowed)
    machine.forked = False
    assert machine.run("new", "my_robot", "--folder", str(made)).returncode == 0
    metadata = made / "src" / "my_robot-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my_robot\nVersion: 0.1.0\n")
    (metadata / "entry_points.txt").write_text("[strands_robots.robots]\nmy_robot = my_robot:MyRobot\n")
    return machine


def test_its_tests_pass_as_written(machine: Machine, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path / "my_robot" / "tests")]
    folder = tmp_path / "my_robot"
    ran = subprocess.run(
        command, cwd=folder, env=machine.environment, capture_output=True, text=True, timeout=WITHIN_S, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_it_conforms_and_the_report_is_json(machine: Machine) -> None:
    code, report = machine.last_json("conform", "my_robot.conformance:subject", "--tier", "bronze")
    assert (code, report["tier"], report["failed"]) == (0, "bronze", 0)


def test_it_is_served_by_its_name_and_called(machine: Machine) -> None:
    with machine.serving("spinner", robot="my_robot"):
        code, answer = machine.json("call", "spinner", "spin", "seconds=0.2")
        assert (code, answer["task_status"]) == (0, "completed"), answer
        assert answer["angle_deg"] > 0


def test_thirty_lines_of_the_page_are_a_robot_that_is_found_moved_and_stopped(tmp_path: Path) -> None:
    (program,) = (each for each in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "class Spinner" in each)
    assert len(program.splitlines()) <= 30
    (tmp_path / "spinner.py").write_text(program)
    machine = Machine(tmp_path / "state", DEVICE_CONNECT_RPC_ALLOW="strands-robots", STRANDS_ROBOT_COMMAND_ALLOW="spin")
    served = subprocess.Popen([sys.executable, tmp_path / "spinner.py"], env=machine.environment)
    try:
        eventually(lambda: machine.run("peers", "spinner").returncode == 0, within=60, what="the robot on the network")
        code, answer = machine.json("call", "spinner", "spin", "seconds=0.2")
        assert (code, answer["task_status"]) == (0, "completed"), answer
        refused = machine.run("call", "spinner", "spin", "seconds=90")
        assert "seconds must be a finite number from 0.1 to 60, not 90." in refused.stderr
        spinning = machine.start("call", "spinner", "spin", "seconds=60")
        eventually(lambda: machine.json("call", "spinner", "getStatus")[1]["task_status"] == "running", within=60)
        assert "Stopped spin." in machine.run("stop", "spinner").stdout
        assert "spin stopped: it was stopped." in spinning.communicate(timeout=WITHIN_S)[1]
        served.send_signal(signal.SIGINT)
        assert served.wait(WITHIN_S) == 0
    finally:
        served.kill()
        served.wait()


def test_thirty_lines_of_the_page_are_bronze_and_the_report_says_what_silver_needs(tmp_path: Path) -> None:
    (program,) = (each for each in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "class Spinner" in each)
    (tmp_path / "spinner.py").write_text(program)
    machine = Machine(tmp_path / "state", PYTHONPATH=os.pathsep.join([str(tmp_path), *sys.path]))
    conformed = machine.run("conform", "spinner:Spinner")
    assert conformed.returncode == 0, conformed.stderr
    (shown,) = re.findall(r"^Spinner: bronze\n.*?^NOT PROVEN [^\n]*", PAGE, re.DOTALL | re.MULTILINE)
    assert shown in conformed.stdout
