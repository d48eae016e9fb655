"""Robots and leaders of installed packages, as processes: served by name, and imported by no other command."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.installed import install
from fixtures.waiting import eventually

from strands_robots.cli.output import Exit

SOURCE = '''
import threading
from typing import Annotated

from strands_robots import Domain, Permit, verb


class Turntable:
    """A table that turns; ``turns`` is what its emulated motor has done."""

    def __init__(self, label="plain", mode="sim"):
        self.label, self.mode, self.turns = label, mode, 0

    @verb(motion=True, lasts=60.0)
    def turn(self, times: Annotated[int, Domain(1, 10_000)], permit: Permit) -> dict[str, int]:
        """Turn the table."""
        while permit.valid and self.turns < times:
            self.turns += 1
            threading.Event().wait(0.01)
        return {"turns": self.turns}

    @verb(motion=False)
    def read_label(self) -> dict[str, str]:
        """Read its label and mode."""
        return {"label": self.label, "mode": self.mode}


class PanTilt:
    observation_features = action_features = {"pan.pos": float}
    joint_ranges = {"pan.pos": (-90.0, 90.0)}
    is_connected = False

    def __init__(self, port):
        self.port, self.at = port, 0.0

    def connect(self):
        self.is_connected = True

    def disconnect(self):
        self.is_connected = False

    def get_observation(self):
        return {"pan.pos": self.at}

    def send_action(self, action):
        self.at = action["pan.pos"]
        return action


class Wave:
    def __init__(self):
        self.left = 20

    def get_action(self):
        from strands_robots.teleoperators import LeaderFinished
        self.left -= 1
        if self.left < 0:
            raise LeaderFinished("done")
        return {"shoulder_pan": 0.01}
'''

ENTRIES = {
    "strands_robots.robots": {
        "turntable": "my_robots:Turntable",
        "pan_tilt": "my_robots:PanTilt",
        "so100": "my_robots:Turntable",
        "gone": "my_robots:Gone",
    },
    "strands_robots.teleoperators": {"wave": "my_robots:Wave"},
}
ALLOW = {"DEVICE_CONNECT_RPC_ALLOW": "*", "STRANDS_ROBOT_COMMAND_ALLOW": "turn,execute"}


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    return install(tmp_path / "site", "my-robots", SOURCE, ENTRIES)


@pytest.fixture
def machine(tmp_path: Path, imported: Path) -> Iterator[Machine]:
    path = os.pathsep.join(filter(None, (str(imported.parent), os.environ.get("PYTHONPATH"))))
    machine = Machine(tmp_path / "state", PYTHONPATH=path, **ALLOW)
    # A fork has the path of the interpreter that it was forked of.
    machine.forked = False
    return machine


def test_robot_of_a_package_is_served_called_and_stopped_by_its_name(machine: Machine, imported: Path) -> None:
    with machine.serving("table-1", "--set", "label=fast", robot="turntable") as (served, ready):
        assert {"turn", "readLabel"} <= ready["functions"].keys()
        imported.unlink()
        _, described = machine.json("call", "table-1", "readLabel")
        assert (described["label"], described["mode"]) == ("fast", "sim")
        call = machine.start("call", "table-1", "turn", "times=5000", "--json")
        # Until the turn has begun there is nothing to stop.
        eventually(lambda: "turn" in json.dumps(machine.json("stop", "table-1")[1]), within=60)
        out, _ = call.communicate(timeout=60)
        assert call.returncode != 0
        assert "stopped" in out
        # What looks and what stops knows nothing of the package.
        for command in (("peers",), ("estop",), ("lockout",)):
            machine.run(*command)
        assert not imported.exists()
        assert served.poll() is None


def test_device_of_a_package_becomes_a_robot(machine: Machine) -> None:
    with machine.serving("pan-1", "--port", "/dev/null", robot="pan_tilt") as (_, ready):
        assert {"execute", "getState"} & ready["functions"].keys()
        code, answer = machine.json("call", "pan-1", "execute", "instruction=wave", "duration=0.5")
        assert code == 0, answer


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("pan_tilt",), "robot pan_tilt of my-robots 1.0 cannot be made: missing a required argument: 'port'"),
        (("turntable", "--set", "speed=3"), "robot turntable of my-robots 1.0 cannot be made: got an unexpected"),
        (("turntable", "--speed-limit", "3"), "robot turntable of my-robots 1.0 has no option speed_limit"),
        (("turntabel",), "Robots of other packages: gone, pan_tilt, turntable."),
        (("gone",), "robot gone of my-robots 1.0 cannot be loaded: AttributeError"),
    ],
)
def test_refusal_names_the_robot_its_package_and_the_reason(
    machine: Machine, arguments: tuple[str, ...], said: str
) -> None:
    refused = machine.run("serve", *arguments)
    assert refused.returncode == Exit.USAGE, refused.stderr
    assert said in refused.stderr
    assert "Traceback" not in refused.stderr


def test_leader_of_a_package_leads(machine: Machine) -> None:
    ended = machine.run("teleop", "wave", "so100", "--json")
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_doctor_names_each_part_and_what_is_broken(machine: Machine, imported: Path) -> None:
    _, report = machine.json("doctor")
    found = {each["name"]: each for each in report["checks"]}
    assert found["robot turntable"]["mark"] == "ok"
    assert found["teleoperator wave"]["said"] == "my-robots 1.0"
    assert found["robot so100"]["said"] == "my-robots 1.0 cannot take the name of a built-in robot"
    assert (found["robot gone"]["mark"], "AttributeError" in found["robot gone"]["said"]) == ("warn", True)
