"""A real MuJoCo simulation on the network, from discovery to the stop."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    SimulationDeviceDriver,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.bringup import driver_for
from strands_robots.device_connect.client import DeviceEvent
from strands_robots.simulation import Simulation


@pytest.fixture(scope="module")
def link() -> LinkConfig:
    return loopback_config(free_port())


@pytest.fixture(scope="module")
def sim(link: LinkConfig) -> Iterator[Simulation]:
    world = Simulation()
    world.create_world()
    world.add_robot("left", "so100")
    world.add_robot("right", "so100")
    # The thread of the pictures belongs to the world, not to the test that asks for one.
    world.camera_picture("front", 64, 48)
    runtime = init_device_connect_sync(world, peer_id="sim-1", link=link)
    yield world
    stop_device_connect(runtime)
    world.cleanup()


@pytest.fixture
def fleet(link: LinkConfig, sim: Simulation) -> Iterator[FleetClient]:
    with FleetClient(link, "tester") as client:
        yield client
        client.stop("sim-1")


def test_simulation_gets_the_simulation_driver_for_any_peer_type(sim: Simulation) -> None:
    assert isinstance(driver_for(sim, "robot"), SimulationDeviceDriver)


def test_features_and_state_are_answered(fleet: FleetClient) -> None:
    features = fleet.call("sim-1", "getFeatures")
    assert features["status"] == "success"
    assert "left" in str(features)
    state = fleet.call("sim-1", "getStatus")
    assert set(state["robots"]) == {"left", "right"}
    assert state["running_policies"] == {} or state["running_policies"] == []


def test_physics_is_stepped_and_reset_remotely(fleet: FleetClient) -> None:
    before = fleet.call("sim-1", "getStatus")["step_count"]
    assert fleet.call("sim-1", "step", {"n_steps": 10})["status"] == "success"
    assert fleet.call("sim-1", "getStatus")["step_count"] == before + 10
    assert fleet.call("sim-1", "reset")["status"] == "success"
    assert fleet.call("sim-1", "getStatus")["sim_time"] == pytest.approx(0.0, abs=0.1)


def test_arm_moves_with_events_and_stands_still_after_the_stop(fleet: FleetClient, sim: Simulation) -> None:
    events: list[DeviceEvent] = []
    with fleet.subscription("sim-1", events.append):
        answer = fleet.call("sim-1", "execute", {"instruction": "wave", "duration": 100})
        assert answer["status"] == "success", answer
        assert answer["robot_name"] == "left"
        start = joints(fleet)
        eventually(lambda: largest_change(joints(fleet), start) > 0.02)
        assert "stop that first" in fleet.call("sim-1", "execute", {"instruction": "again"})["reason"]
        expected = {"policyStarted", "streamStep", "stateUpdate", "observationUpdate"}
        eventually(lambda: expected <= {event.name for event in list(events)}, what=f"{expected} of a robot that moves")
        stopped = fleet.stop("sim-1")
        assert stopped["status"] == "success", stopped
        assert stopped["stopped"] == ["left"]
        assert stopped["not_stopped"] == []
        eventually(lambda: any(event.name == "policyComplete" for event in events))
    complete = next(event.payload for event in events if event.name == "policyComplete")
    assert (complete["robot_name"], complete["state"]) == ("left", "stopped")
    steps = [event.payload for event in events if event.name == "streamStep"]
    assert [step["step"] for step in steps] == sorted(step["step"] for step in steps)
    assert all(
        isinstance(v, float) for step in steps for v in (*step["observation"].values(), *step["action"].values())
    )
    assert sim.list_policies_running() == []


def test_two_robots_move_at_once_and_one_stop_halts_both(fleet: FleetClient) -> None:
    for name in ("left", "right"):
        answer = fleet.call("sim-1", "execute", {"instruction": "wave", "robot_name": name, "duration": 100})
        assert answer["status"] == "success", answer
    assert sorted(fleet.stop("sim-1")["stopped"]) == ["left", "right"]


def test_stream_loses_no_step(fleet: FleetClient) -> None:
    events: list[DeviceEvent] = []
    with fleet.subscription("sim-1", events.append):
        fleet.call("sim-1", "execute", {"instruction": "wave", "duration": 3})
        eventually(lambda: any(event.name == "policyComplete" for event in events), within=20)
    complete = next(event.payload for event in events if event.name == "policyComplete")
    steps = [event.payload["step"] for event in events if event.name == "streamStep"]
    assert complete["state"] == "completed"
    assert len(steps) == len(set(steps))
    assert abs(len(steps) - complete["steps"]) <= 1


def joints(fleet: FleetClient) -> dict[str, float]:
    from strands_robots.policies.base import plain_numbers  # noqa: PLC0415 - beside its only use

    robots: dict[str, Any] = fleet.call("sim-1", "getStatus")["robots"]
    return plain_numbers(robots["left"].get("joints", robots["left"]))


def largest_change(now: dict[str, float], then: dict[str, float]) -> float:
    assert now
    return max(abs(now[name] - then[name]) for name in now)


def test_tip_is_moved_to_a_point_and_the_answer_tells_its_error(fleet: FleetClient) -> None:
    goal = {"x": 0.26, "y": -0.05, "z": 0.08, "robot_name": "right"}
    answer = fleet.call("sim-1", "moveTo", {**goal, "speed": 1.0}, 30.0)
    assert (answer["status"], answer["task_status"]) == ("success", "completed"), answer
    assert answer["error_mm"] < 3.0
    pose = fleet.call("sim-1", "getPose", {"robot_name": "right"})
    assert [pose[axis] for axis in "xyz"] == pytest.approx([0.26, -0.05, 0.08], abs=3e-3)


def test_stop_is_carried_out_while_a_caller_waits_for_a_motion(fleet: FleetClient, sim: Simulation) -> None:
    with ThreadPoolExecutor(1) as pool:
        goal = {"x": 0.25, "y": 0.2, "z": 0.06, "speed": 0.1, "robot_name": "left"}
        waiting = pool.submit(fleet.call, "sim-1", "moveTo", goal, 40.0)
        eventually(lambda: any(row["step"] > 5 for row in sim.list_policies_running()))
        assert fleet.stop("sim-1")["status"] == "success"
        ended = waiting.result(10.0)
    assert (ended["status"], ended["task_status"], ended["why"]) == ("error", "stopped", "it was stopped")


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        ({"x": 0.25, "y": 0.0}, "z is missing"),
        ({"x": 0.25, "y": True, "z": 0.1}, "y must be a finite number"),
        ({"x": 0.25, "y": 0.0, "z": 0.1, "speed": 0}, "speed must be a finite number above 0"),
        ({"x": 0.25, "y": 0.0, "z": 0.1, "approach": 100}, "approach must be a finite number from -90 to 90"),
        ({"x": 0.9, "y": 0.0, "z": 0.1}, "out of reach; the nearest reachable point is"),
    ],
)
def test_goal_that_cannot_be_is_refused_by_name(fleet: FleetClient, goal: dict[str, Any], reason: str) -> None:
    answer = fleet.call("sim-1", "moveTo", {**goal, "robot_name": "left"})
    assert answer["status"] == "error"
    assert reason in answer["reason"]


def test_picture_comes_over_the_network(fleet: FleetClient) -> None:
    assert "front" in fleet.call("sim-1", "listCameras")["cameras"]
    answer = fleet.call("sim-1", "getPicture", {"camera": "table"})
    assert (answer["camera"], answer["width"], answer["height"]) == ("table", 640, 480)
    assert base64.b64decode(answer["jpeg"]).startswith(b"\xff\xd8")
