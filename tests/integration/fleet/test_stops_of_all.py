"""Stop, lock, resume and enrolment of a whole fleet from Python, on each network and on both at once."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots import connect, errors
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.fleet import Fleet
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.lockouts import Enrolled
from strands_robots.mesh import init_mesh
from strands_robots.mesh.session import clear_peers
from strands_robots.safety.ed25519 import keygen, load_signing_key

PASSPHRASE = "Plenty of 4 different words"
TASK = {"instruction": "wave", "duration": 300.0, "policy_provider": "mock"}
NETWORKS = {"device_connect": (DEVICE_CONNECT,), "mesh": (MESH,), "both": (DEVICE_CONNECT, MESH)}


@dataclass
class Cell:
    """Toy robots, one on each network of the test, the fleet that reaches them, and the operator's key."""

    toys: dict[str, ToyRobot]
    fleet: Fleet
    key: Any

    def move(self) -> None:
        """Have every robot move."""
        for toy in self.toys.values():
            toy.start_task(**TASK)
            eventually(lambda toy=toy: toy.writes, what="a first write")

    @property
    def moving(self) -> list[str]:
        return [name for name, toy in self.toys.items() if toy.get_task_status()["task_status"] == "running"]


@pytest.fixture
def key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    file = tmp_path / "operator.pem"
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(file, PASSPHRASE))
    return load_signing_key(file, PASSPHRASE)


@pytest.fixture(params=list(NETWORKS))
def cell(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, key: Any, patient_halts: None
) -> Iterator[Cell]:
    port = free_port()
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(port))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "strands-robots")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    with ExitStack() as stack:
        toys = {}
        for network in NETWORKS[request.param]:
            name = f"{network.replace('_', '-')}-arm"
            toy = toys[name] = ToyRobot(name)
            stack.callback(toy.close)
            if network == DEVICE_CONNECT:
                runtime = init_device_connect_sync(toy, peer_id=name, link=loopback_config(port))
                stack.callback(stop_device_connect, runtime)
            else:
                mesh = init_mesh(toy, name, "sim")
                assert mesh is not None
                stack.callback(mesh.close)
        yield Cell(toys, stack.enter_context(connect()), key)
    clear_peers()


def test_stop_halts_every_robot_and_locks_none(cell: Cell) -> None:
    cell.move()
    stop = cell.fleet.stop()
    assert {name: verdict.stopped for name, verdict in stop.items()} == dict.fromkeys(cell.toys, True)
    assert (stop.ok, stop.missing, stop.estop_id) == (True, (), "")
    assert cell.moving == []
    assert all(toy.start_task(**TASK)["status"] == "success" for toy in cell.toys.values())


def test_emergency_stop_locks_every_robot_until_the_operator_resumes_it(cell: Cell) -> None:
    cell.move()
    stop = cell.fleet.estop("a hand in the cell")
    assert {name: verdict.stopped for name, verdict in stop.items()} == dict.fromkeys(cell.toys, True)
    assert stop.ok, str(stop)
    assert cell.moving == []
    with pytest.raises(errors.LockoutError):
        robot = next(iter(cell.fleet.robots()))
        robot.call("execute" if robot.network == DEVICE_CONNECT else "start", **TASK)
    # One press is one epoch, on whichever network it came.
    reports = cell.fleet.lockouts()
    assert {name: [each.epoch for each in report.lockouts] for name, report in reports.items()} == {
        name: [stop.estop_id] for name in cell.toys
    }
    assert all(free for free, _ in cell.fleet.resume(cell.key).values())
    assert cell.moving == []
    cell.move()
    # The second time is like the first.
    again = cell.fleet.estop()
    assert again.ok, str(again)
    assert again.estop_id != stop.estop_id


def test_one_robot_is_stopped_and_resumed_alone(cell: Cell) -> None:
    cell.move()
    # Of a robot that nobody knows yet it is not sure on which network it is, so every robot of the others would stop.
    assert [robot.id for robot in cell.fleet.robots()] == sorted(cell.toys)
    one, *others = sorted(cell.toys)
    stop = cell.fleet.estop(only=one)
    assert stop[one].stopped is True
    assert cell.moving == others
    assert list(cell.fleet.resume(cell.key, one)) == [one]
    with pytest.raises(errors.NoSuchRobotError, match="nobody"):
        cell.fleet.resume(cell.key, "nobody")


def test_robot_that_does_not_stop_is_named(cell: Cell) -> None:
    cell.move()
    stubborn = max(cell.toys)
    cell.toys[stubborn].stubborn = True
    for stop in (cell.fleet.stop(), cell.fleet.estop()):
        assert stop[stubborn].stopped is False
        assert not stop.ok
        assert stop.missing == (stubborn,)
        assert f"{stubborn} did not stop" in str(stop)
        assert all(stop[name].stopped for name in cell.toys if name != stubborn)


def test_robots_are_enrolled_and_known_again(cell: Cell) -> None:
    first = cell.fleet.enroll()
    assert {name: each.outcome for name, each in first.items()} == dict.fromkeys(cell.toys, Enrolled.NEW)
    assert all(each.fingerprint for each in first.values())
    assert {each.outcome for each in cell.fleet.enroll().values()} == {Enrolled.KNOWN}
    stop = cell.fleet.estop()
    assert stop.ok, str(stop)


def test_robot_of_a_network_that_is_gone_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, patient_halts: None
) -> None:
    port, mesh_port = free_port(), free_port()
    monkeypatch.setenv("STRANDS_DC_PORT", str(port))
    monkeypatch.setenv("STRANDS_MESH_PORT", str(mesh_port))
    state = tmp_path / "far"
    state.mkdir(mode=0o700)
    peer = MeshPeer("far-arm", "world", {"STRANDS_MESH_PORT": str(mesh_port), "STRANDS_STATE_DIR": str(state)})
    toy = ToyRobot("toy")
    runtime = init_device_connect_sync(toy, peer_id="arm-1", link=loopback_config(port))
    try:
        with connect() as fleet:
            assert fleet.stop()["far-arm"].stopped is True
            peer.kill()
            stop = fleet.stop()
            assert stop["arm-1"].stopped is True
            assert stop["far-arm"].stopped is None
            assert stop.missing == ("far-arm",)
        # A fleet that is joined without the mesh still names the robot that this machine remembers there.
        with connect() as fleet:
            assert list(fleet.absent) == [MESH]
            stop = fleet.estop()
            assert stop["far-arm"].stopped is None
            assert not stop.ok
    finally:
        stop_device_connect(runtime)
        toy.close()
        peer.close()
        clear_peers()


@pytest.mark.parametrize("verb", ["stop", "estop"])
def test_command_stops_the_robots_of_both_networks_of_a_profile(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, patient_halts: None, verb: str
) -> None:
    port, mesh_port = free_port(), free_port()
    profile = tmp_path / "lab.toml"
    profile.write_text(f'name = "desk"\nport = {port}\n[mesh]\nport = {mesh_port}\n')
    profile.chmod(0o600)
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "*")
    state = tmp_path / "far"
    state.mkdir(mode=0o700)
    peer = MeshPeer("far-arm", "world", {"STRANDS_MESH_PORT": str(mesh_port), "STRANDS_STATE_DIR": str(state)})
    toy = ToyRobot("toy")
    runtime = init_device_connect_sync(toy, peer_id="arm-1", link=loopback_config(port))

    def ran() -> tuple[int, dict[str, Any]]:
        line = [sys.executable, "-m", "strands_robots.cli", verb, "--all", "--fleet", str(profile), "--json"]
        run = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
        return run.returncode, json.loads(run.stdout)

    try:
        code, facts = ran()
        assert (code, facts["mesh"]) == (0, {"far-arm": True}), facts
        assert toy.gate.lockout("execute") is not None or verb == "stop"
        peer.kill()
        code, facts = ran()
        assert (code, facts["mesh"]) == (3, {"far-arm": None}), facts
        assert "On mesh: " in facts["reason"]
        assert "far-arm" in str(facts["mesh"])
    finally:
        stop_device_connect(runtime)
        toy.close()
        peer.close()


def test_profile_of_a_mesh_alone_needs_no_word_for_a_stop(tmp_path: Path) -> None:
    mesh_port = free_port()
    profile = tmp_path / "hall.toml"
    profile.write_text(f"[mesh]\nport = {mesh_port}\n")
    profile.chmod(0o600)
    state = tmp_path / "far"
    state.mkdir(mode=0o700)
    with MeshPeer("far-arm", "world", {"STRANDS_MESH_PORT": str(mesh_port), "STRANDS_STATE_DIR": str(state)}):
        for command in (("stop", "--all"), ("estop",), ("enroll", "far-arm", "--mesh")):
            line = [sys.executable, "-m", "strands_robots.cli", *command, "--fleet", str(profile), "--json"]
            run = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
            assert run.returncode == 0, run.stdout + run.stderr
            assert "far-arm" in run.stdout
