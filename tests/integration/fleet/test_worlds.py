"""A simulated world is a collection of robots, each a robot like any other, on both networks."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fixtures.waiting import eventually, free_port

from strands_robots import Simulation, connect, errors
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.fleet import RemoteRobot
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.mesh import init_mesh
from strands_robots.mesh.session import clear_peers


@pytest.fixture(params=[DEVICE_CONNECT, MESH])
def world(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, patient_halts: None
) -> Iterator[tuple[Simulation, RemoteRobot]]:
    port = free_port()
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(port))
    simulation = Simulation(tool_name="cell", realtime=False)
    with ExitStack() as stack:
        stack.callback(clear_peers)
        stack.callback(simulation.cleanup)
        for name in ("left", "right"):
            simulation.add_robot(name, model="so100")
        if request.param == DEVICE_CONNECT:
            runtime = init_device_connect_sync(simulation, peer_id="cell-1", link=loopback_config(port))
            stack.callback(stop_device_connect, runtime)
        else:
            peer = init_mesh(simulation, "cell-1", "sim")
            assert peer is not None
            stack.callback(peer.close)
        fleet = stack.enter_context(connect())
        yield simulation, fleet["cell-1"]


def moving(simulation: Simulation) -> set[str]:
    return {str(row["robot"]) for row in simulation.list_policies_running()}


def test_each_robot_of_a_world_is_moved_and_halted_alone(world: tuple[Simulation, RemoteRobot]) -> None:
    simulation, cell = world
    robots = cell.robots
    assert list(robots) == ["left", "right"]
    left, right = robots["left"], robots["right"]
    assert (left.id, left.model) == ("cell-1/left", "left")
    assert "robot_name" not in inspect.signature(left.move_joints).parameters
    assert {"step", "reset"} & set(left.verbs) == set()
    assert left.move_joints(joints={"wrist_flex": 10.0}, speed=1.0)["task_status"] == "completed"
    at = {name: robot.state()["joints"] for name, robot in robots.items()}
    assert at["left"] != at["right"]
    assert left.features()["status"] == "success"
    for _ in range(2):
        for robot in (left, right):
            start = {"instruction": "wave", "policy_provider": "mock", "duration": 300.0}
            (robot.execute if cell.network == DEVICE_CONNECT else robot.start)(**start)
        eventually(lambda: moving(simulation) == {"left", "right"})
        assert left.halt().stopped is True
        assert moving(simulation) == {"right"}
        assert cell.halt().stopped is True
        assert moving(simulation) == set()


def test_one_robot_of_a_world_is_held_alone(world: tuple[Simulation, RemoteRobot]) -> None:
    _, cell = world
    with connect(name="other") as others:
        other = others["cell-1"]
        with cell.robots["left"].control(ttl_s=30) as left:
            assert left.move_joints(joints={"wrist_flex": 5.0}, speed=1.0)["task_status"] == "completed"
            with pytest.raises(errors.ControlError):
                other.robots["left"].move_joints(joints={"wrist_flex": 0.0})
            assert (
                other.robots["right"].move_joints(joints={"wrist_flex": 5.0}, speed=1.0)["task_status"] == "completed"
            )


def test_robot_that_is_no_world_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(port))
    from fixtures.barista import Barista  # noqa: PLC0415 - this test's robot alone

    runtime = init_device_connect_sync(Barista(), peer_id="barista-1", link=loopback_config(port))
    try:
        with connect(mesh=False) as fleet:
            assert fleet["barista-1"].robots == {}
    finally:
        stop_device_connect(runtime)
