"""Log, head and anchor of a robot's machine put back together: other machines find it, on both networks."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND
from fixtures.nats_server import NatsServer
from fixtures.plane_process import planned
from fixtures.stop_controller import controller
from fixtures.waiting import eventually
from tests.integration.mesh.networks import network

from strands_robots.audit.verification import WITNESS
from strands_robots.device_connect.backends import LinkConfig

SECRET = {"STRANDS_MESH_AUDIT_PSK": "the secret of this machine's audit"}

Files = dict[Path, bytes]


class Machine:
    """The state directory of one machine, its processes, and what an attacker does to it."""

    def __init__(self, folder: Path, name: str) -> None:
        self.state = folder / name
        self.state.mkdir(mode=0o700, exist_ok=True)
        self.environment = {"STRANDS_STATE_DIR": str(self.state), **SECRET}
        self.log = self.state / "mesh_audit.jsonl"

    def copy(self) -> Files:
        return {path: path.read_bytes() for path in self.state.rglob("*") if path.is_file()}

    def roll_back(self, older: Files) -> None:
        for path in self.copy():
            if path not in older:
                path.unlink()
        for path, data in older.items():
            path.write_bytes(data)

    def verify(self, *witnesses: Path) -> int:
        """Return the exit code of ``audit verify`` on this machine."""
        options = [part for each in witnesses for part in ("--with", str(each))]
        line = [*COMMAND, "audit", "verify", *options]
        return subprocess.run(line, env={**os.environ, **self.environment}, capture_output=True, check=False).returncode

    def witnessed(self, robot: str) -> bool:
        if not self.log.exists():
            return False
        return any(f'"{WITNESS}"' in line and f'"{robot}"' in line for line in self.log.read_text().splitlines())


@pytest.fixture
def link() -> Iterator[LinkConfig]:
    with NatsServer() as server:
        yield LinkConfig(transport="nats", connect=(server.url,))


def test_rollback_is_found_by_the_controller_and_by_another_robot(tmp_path: Path, link: LinkConfig) -> None:
    arm, other, desk = (Machine(tmp_path, name) for name in ("arm-1", "arm-2", "safety-1"))
    with planned(["arm-2"], link, **other.environment), controller(link, environment=desk.environment) as hand:
        with planned(["arm-1"], link, **arm.environment) as robot:
            eventually(lambda: hand.ask("stop", ["arm-1", "arm-2"], 5.0)["ok"], 30, "both robots answer")
            robot.ask("audit")
        older = arm.copy()
        assert arm.verify() == 0
        with planned(["arm-1"], link, **arm.environment) as robot:
            robot.ask("stop")
            robot.ask("audit")
            hand.ask("check_in", 0.1)
            eventually(lambda: other.witnessed("arm-1") and desk.witnessed("arm-1"), 30, "two witnesses")
    assert arm.verify(other.log, desk.log) == 0
    arm.roll_back(older)
    assert arm.verify() == 0, "one machine alone finds nothing"
    assert arm.verify(other.log) == 1
    assert arm.verify(desk.log) == 1


@pytest.mark.parametrize("way", ["check-in", "stop"])
def test_rollback_is_found_by_others_on_the_mesh(tmp_path: Path, way: str) -> None:
    settings = {**SECRET, "STRANDS_CHECKIN_TIMEOUT_S": "3600"}
    with network("zenoh", tmp_path, settings) as net:
        console: Any = net.join("console", "none")
        net.join("arm-2", "arm")
        robot: Any = net.join("arm-1", "arm")
        for each in (console, net.peers["arm-2"], robot):
            each.sees(*({"console", "arm-1", "arm-2"} - {each.peer_id}))
        console.ask("estop")
        arm, other, desk = (Machine(tmp_path, name) for name in ("arm-1", "arm-2", "console"))
        eventually(lambda: arm.log.exists() and arm.log.stat().st_size, 20)
        robot.close()
        older = arm.copy()
        assert arm.verify() == 0
        robot = net.join("arm-1", "arm")
        robot.sees("console", "arm-2")
        console.sees("arm-1")
        robot.ask("clear")
        eventually(lambda: "resume_local" in robot.ask("audited"))
        witnesses = [desk]
        if way == "stop":
            console.ask("estop")
        else:
            console.ask("check_in", 0.1)
            witnesses.append(other)
        eventually(lambda: all(each.witnessed("arm-1") for each in witnesses), 30, "the witnesses")
    assert arm.verify(*(each.log for each in witnesses)) == 0
    arm.roll_back(older)
    assert arm.verify() == 0, "one machine alone finds nothing"
    for each in witnesses:
        assert arm.verify(each.log) == 1
