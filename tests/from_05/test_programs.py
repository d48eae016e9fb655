"""Programs as users of strands-robots 0.5 write them: each runs, or ends in one sentence that says what to change."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.reachy_daemon.process import Daemon, Kind

PROGRAMS = sorted((Path(__file__).parent / "programs").glob("*.py"))
WITHIN_S = 100.0

ENDS = {
    "ros_arm_bridge": (
        "enable_commands must be false on an unsecured ROS 2 graph, where anyone could drive the robot: "
        "ROS_SECURITY_ENABLE is not true. "
        "Set STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE=1 to take commands all the same."
    ),
    "ros_base": (
        "link must be a link of strands_robots.ros.link, not '/base/cmd_vel': "
        "give MobileBaseRobot its node_name, link and command_topic in this order."
    ),
}
"""The sentence that a program ends in; one that is not here runs."""

SETTINGS = {
    "reachy_mini": {"DEVICE_CONNECT_RPC_ALLOW": "anonymous", "STRANDS_ROBOT_COMMAND_ALLOW": "look,antennas,nod"},
}
"""What the page says to set for a program."""

REFUSED = {
    "device_connect_driver": {"stop"},
    "robot_mesh_tool": {"subscribe", "inbox", "unsubscribe"},
    "ros_tool": {"echo", "publish"},
}
"""The calls of a program that are refused, or find nothing; every other call succeeds."""


def run(program: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, program, str(folder), *arguments],
        env={**Machine(folder / "state").environment, **SETTINGS.get(program.stem, {})},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=WITHIN_S,
        check=False,
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "state").mkdir(mode=0o700)
    return tmp_path


@pytest.fixture(scope="module")
def daemon() -> Iterator[Daemon]:
    with Daemon(Kind("1.13.0", wireless=True)) as running:
        yield running


def test_there_are_twelve() -> None:
    assert len(PROGRAMS) == 12


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.stem)
def test_program_runs_or_says_what_to_change(program: Path, folder: Path, daemon: Daemon) -> None:
    ended = run(program, folder, str(daemon.port))
    if program.stem not in ENDS:
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert "Traceback" not in ended.stderr, ended.stderr
        failed = set(re.findall(r"^(\w+):? (?:error|False)\b", ended.stdout, flags=re.MULTILINE))
        assert failed == REFUSED.get(program.stem, set()), ended.stdout + ended.stderr
        return
    last = ended.stderr.strip().splitlines()[-1]
    assert re.fullmatch(rf"[\w.]+: {re.escape(ENDS[program.stem])}", last), ended.stdout + ended.stderr


def test_page_names_the_settings_of_each_program() -> None:
    page = (Path(__file__).parents[2] / "docs" / "from-0.5.md").read_text(encoding="utf-8")
    for settings in SETTINGS.values():
        for name, value in settings.items():
            assert f"`{name}={value}`" in page
