"""The examples as processes, offline."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fixtures.command_line import COMMAND, Machine
from fixtures.waiting import accepts, eventually

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
WITHIN_S = 60.0
PYTHON = [sys.executable, "-W", "error::DeprecationWarning"]
pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    return Machine(tmp_path).environment


@contextmanager
def example(name: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """A running example; it has to end in order on Ctrl-C."""
    process = subprocess.Popen([*PYTHON, EXAMPLES / name], env=environment, text=True)
    try:
        yield process
        process.send_signal(signal.SIGINT)
        assert process.wait(WITHIN_S) == 0
    finally:
        process.kill()
        process.wait()


def command(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    line = [*COMMAND, *words]
    return subprocess.run(line, env=environment, capture_output=True, text=True, timeout=WITHIN_S, check=False)


def live(environment: dict[str, str], peer: str) -> bool:
    return command(environment, "peers", peer, "--timeout", "1").returncode == 0


def test_the_served_arm_is_driven_by_an_agents_tools(environment: dict[str, str]) -> None:
    with example("serve_arm.py", environment):
        eventually(lambda: live(environment, "so100-lab-1"), within=WITHIN_S, what="the arm is live")
        # A caller that came before the arm may have had the meeting port, and the arm takes it when that one goes.
        eventually(lambda: accepts(int(environment["STRANDS_DC_PORT"])), within=WITHIN_S, what="the arm has the port")
        line = [*PYTHON, EXAMPLES / "drive_from_agent.py"]
        driven = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=WITHIN_S, check=False)
        assert driven.returncode == 0, driven.stderr
        assert "Driving so100-lab-1." in driven.stdout


def test_without_a_robot_the_agent_says_so(environment: dict[str, str]) -> None:
    line = [*PYTHON, EXAMPLES / "drive_from_agent.py"]
    driven = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=WITHIN_S, check=False)
    assert driven.returncode != 0


def test_a_robot_of_ones_own_moves_for_the_allowed_and_stops_for_everybody(environment: dict[str, str]) -> None:
    allowed = {"DEVICE_CONNECT_RPC_ALLOW": "strands-robots", "STRANDS_ROBOT_COMMAND_ALLOW": "execute"}
    with example("own_driver.py", environment | allowed):
        eventually(lambda: live(environment, "pan-tilt"), within=WITHIN_S, what="the robot is live")
        wave = ("call", "pan-tilt", "execute", "instruction=look around", "duration=600")
        assert command(environment, *wave, "--as", "stranger").returncode == 1
        assert command(environment, *wave).returncode == 0
        before = json.loads(command(environment, "call", "pan-tilt", "getState", "--json").stdout)
        assert before["joints"]
        stopped = command(environment, "stop", "pan-tilt")
        assert stopped.returncode == 0, stopped.stderr


def test_a_robot_that_knows_tasks_alone_is_started_for_the_allowed_and_stops(environment: dict[str, str]) -> None:
    allowed = {"DEVICE_CONNECT_RPC_ALLOW": "strands-robots", "STRANDS_ROBOT_COMMAND_ALLOW": "execute"}
    with example("own_robot.py", environment | allowed):
        eventually(lambda: live(environment, "turntable"), within=WITHIN_S, what="the robot is live")
        turn = ("call", "turntable", "execute", "instruction=turn", "duration=600")
        assert command(environment, *turn, "--as", "stranger").returncode == 1
        assert command(environment, *turn).returncode == 0
        doing = json.loads(command(environment, "call", "turntable", "getStatus", "--json").stdout)
        assert doing["task_status"] == "running"
        stopped = command(environment, "stop", "turntable")
        assert stopped.returncode == 0, stopped.stderr
        done = json.loads(command(environment, "call", "turntable", "getStatus", "--json").stdout)
        assert done["task_status"] == "idle"
        assert 0 < done["step_count"] < 30_000


def test_a_robots_own_verb_is_called_by_the_allowed_and_stopped_in_its_middle(environment: dict[str, str]) -> None:
    allowed = {"DEVICE_CONNECT_RPC_ALLOW": "strands-robots", "STRANDS_ROBOT_COMMAND_ALLOW": "brewCoffee"}
    with example("barista.py", environment | allowed):
        eventually(lambda: live(environment, "barista"), within=WITHIN_S, what="the robot is live")
        brew = ("call", "barista", "brewCoffee", "cups=1")
        assert command(environment, *brew, "--as", "stranger").returncode == 1
        made = command(environment, *brew)
        assert made.returncode == 0, made.stderr
        assert "brewCoffee completed." in made.stdout
        refused = command(environment, "call", "barista", "brewCoffee", "cups=9")
        assert refused.returncode == 2
        assert "cups must be an integer from 1 to 8, not 9." in refused.stderr
        assert "result: 242.0" in command(environment, "call", "barista", "beansLeft").stdout
        brewing = subprocess.Popen([*COMMAND, "call", "barista", "brewCoffee", "cups=8"], env=environment)
        try:
            status = ("call", "barista", "getStatus", "--json")
            eventually(lambda: json.loads(command(environment, *status).stdout).get("verb"), within=WITHIN_S)
            stopped = command(environment, "stop", "barista")
            assert stopped.returncode == 0, stopped.stderr
            assert "Stopped brewCoffee." in stopped.stdout
            brewing.wait(WITHIN_S)
        finally:
            brewing.kill()
            brewing.wait()


@pytest.mark.parametrize(("name", "peer"), [("own_driver.py", "pan-tilt"), ("own_robot.py", "turntable")])
def test_a_robot_of_ones_own_moves_for_nobody_unless_told(environment: dict[str, str], name: str, peer: str) -> None:
    with example(name, environment):
        eventually(lambda: live(environment, peer), within=WITHIN_S, what="the robot is live")
        refused = command(environment, "call", peer, "execute", "instruction=look around")
        assert refused.returncode == 1
        assert "DEVICE_CONNECT_RPC_ALLOW" in refused.stderr
