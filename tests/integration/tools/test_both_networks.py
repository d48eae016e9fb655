"""``robot_mesh`` on Device Connect and on the mesh at once, with real robots on both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import accepts, eventually, free_port

from strands_robots import connect
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.mesh.session import clear_peers
from strands_robots.tools import robot_mesh

WAVE = {"action": "tell", "instruction": "wave", "duration": 300.0}


class Cell:
    """A toy robot ``arm-1`` on Device Connect, here, and robots on the mesh in processes of their own."""

    def __init__(self, folder: Path, port: int, mesh_port: int, stack: ExitStack) -> None:
        self._folder, self._mesh_port, self._stack = folder, mesh_port, stack
        self.toy = ToyRobot("arm-1")
        stack.callback(self.toy.close)
        runtime = init_device_connect_sync(self.toy, peer_id="arm-1", link=loopback_config(port))
        stack.callback(stop_device_connect, runtime)

    def serve_on_the_mesh(self, name: str) -> MeshPeer:
        state = self._folder / name
        state.mkdir(mode=0o700)
        peer = MeshPeer(name, "world", {"STRANDS_MESH_PORT": str(self._mesh_port), "STRANDS_STATE_DIR": str(state)})
        self._stack.callback(peer.close)
        eventually(lambda: accepts(self._mesh_port), what="the mesh's hub")
        return peer

    @property
    def moving(self) -> bool:
        return bool(self.toy.get_task_status()["task_status"] == "running")


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, patient_halts: None) -> Iterator[Cell]:
    port, mesh_port = free_port(), free_port()
    monkeypatch.setenv("STRANDS_DC_PORT", str(port))
    monkeypatch.setenv("STRANDS_MESH_PORT", str(mesh_port))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    with ExitStack() as stack:
        yield Cell(tmp_path, port, mesh_port, stack)
    clear_peers()


def told(name: str) -> dict[str, Any]:
    """Have a robot move; return the tool's answer."""
    answer: dict[str, Any] = robot_mesh(**WAVE, target=name)
    return answer


def test_robot_that_is_on_the_mesh_alone_is_found_driven_stopped_and_locked(cell: Cell) -> None:
    cell.serve_on_the_mesh("far-arm")
    peers = robot_mesh(action="peers")
    assert {row["id"]: row["network"] for row in peers["peers"]} == {"arm-1": "device_connect", "far-arm": "mesh"}
    for name in ("arm-1", "far-arm"):
        assert told(name)["status"] == "success"
        assert robot_mesh(action="status", target=name)["task_status"] == "running"
        assert robot_mesh(action="stop", target=name)["stopped"] is True
        assert told(name)["status"] == "success"
    stopped = robot_mesh(action="stop")
    assert (stopped["status"], stopped["stopped"]) == ("success", True), stopped
    assert set(stopped["robots"]) == {"arm-1", "far-arm"}
    locked = robot_mesh(action="emergency_stop", instruction="smoke")
    assert (locked["status"], locked["stopped"]) == ("success", True), locked
    for name in ("arm-1", "far-arm"):
        refused = told(name)
        assert refused["status"] == "error"
        assert "lock" in refused["reason"]
    assert not cell.moving


def test_calls_of_the_older_tool_find_drive_and_stop_robots_of_both_networks(cell: Cell) -> None:
    cell.serve_on_the_mesh("far-arm")
    for name in ("arm-1", "far-arm"):
        assert robot_mesh(action="ping", target=name, timeout=30.0)["latency_ms"] > 0
        start = '{"action": "start", "policy_provider": "mock", "instruction": "wave", "duration": 300.0}'
        started = robot_mesh(action="send", target=name, command=start)
        assert started["status"] == "success", started
        running = robot_mesh(action="send", target=name, command='{"action": "status"}')
        assert running["task_status"] == "running", running
        assert robot_mesh(action="send", target=name, command='{"action": "stop"}')["stopped"] is True
        misspelt = start.replace("duration", "durration")
        refused = robot_mesh(action="send", target=name, command=misspelt)
        assert (refused["status"], "durration" in refused["reason"]) == ("error", True), refused
    assert robot_mesh(action="rpc", target="arm-1", function="getFeatures")["status"] == "success"
    assert told("arm-1")["status"] == "success"
    asked = robot_mesh(action="broadcast", command='{"action": "status"}')
    assert {row["robot_id"]: row["task_status"] for row in asked["responses"]}.keys() == {"arm-1", "far-arm"}, asked
    motion = robot_mesh(action="broadcast", command='{"action": "start", "instruction": "wave"}')
    assert "give a motion to each robot by tell" in motion["reason"]
    stopped = robot_mesh(action="broadcast", command='{"action": "stop"}')
    assert (stopped["stopped"], set(stopped["robots"])) == (True, {"arm-1", "far-arm"}), stopped
    assert not cell.moving


def test_robot_of_a_network_that_is_gone_is_named_by_every_stop(cell: Cell) -> None:
    far = cell.serve_on_the_mesh("far-arm")
    assert robot_mesh(action="stop")["status"] == "success"
    far.kill()
    for action in ("stop", "emergency_stop"):
        answer = robot_mesh(action=action)
        assert (answer["status"], answer["stopped"]) == ("error", None)
        assert answer["silent"] == ["far-arm"]
        assert "far-arm" in answer["reason"]
        assert "stopped" in answer["robots"]["arm-1"].lower()


def test_visitors_that_have_left_are_missed_by_no_stop(cell: Cell) -> None:
    cell.serve_on_the_mesh("far-arm")
    with connect(name="desk") as fleet:
        assert set(fleet["far-arm"].status())
        for name in ("arm-1", "far-arm"):
            assert robot_mesh(action="status", target=name)["status"] == "success"
    for action in ("stop", "emergency_stop"):
        answer = robot_mesh(action=action)
        assert (answer["status"], answer["silent"]) == ("success", []), answer


def test_motion_of_an_id_that_two_robots_bear_is_refused_and_a_stop_reaches_both(cell: Cell) -> None:
    other = cell.serve_on_the_mesh("arm-1")
    cell.toy.start_task("wave", duration=300.0)
    other.ask("start", "wave")
    for refused in (told("arm-1"), robot_mesh(action="release_torque", target="arm-1")):
        assert refused["status"] == "error"
        assert "device_connect and mesh both have a robot of this id" in refused["reason"]
    # A read moves neither of them.
    assert robot_mesh(action="status", target="arm-1")["status"] == "success"
    stopped = robot_mesh(action="stop", target="arm-1")
    assert (stopped["status"], stopped["stopped"]) == ("success", True), stopped
    assert set(stopped["robots"]) == {"arm-1 on device_connect", "arm-1 on mesh"}
    assert not cell.moving


def test_absent_robot_is_named_with_the_near_ones_of_both_networks(cell: Cell) -> None:
    cell.serve_on_the_mesh("arm-2")
    refused = robot_mesh(action="status", target="arm-3")
    assert refused["reason"] == "No robot 'arm-3' is in reach. Near it: arm-2, arm-1."


def test_robot_beside_a_mesh_that_is_not_there_is_all_there_is(cell: Cell) -> None:
    peers = robot_mesh(action="peers")
    assert [row["id"] for row in peers["peers"]] == ["arm-1"]
    assert "mesh" not in peers["content"][0]["text"]
    assert robot_mesh(action="emergency_stop")["stopped"] == {"arm-1": pytest.approx(0.0, abs=60_000.0)}


@pytest.mark.parametrize(
    ("variable", "network", "other"),
    [("STRANDS_ROBOT_MESH_DC", "mesh", "arm-1"), ("STRANDS_MESH", "device_connect", "far-arm")],
)
def test_network_that_is_switched_off_is_left_out(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, variable: str, network: str, other: str
) -> None:
    cell.serve_on_the_mesh("far-arm")
    monkeypatch.setenv(variable, "false")
    assert [row["network"] for row in robot_mesh(action="peers")["peers"]] == [network]
    assert other in robot_mesh(action="status", target=other)["reason"]
