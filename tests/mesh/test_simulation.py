"""A real simulated arm on the mesh: watched, started, stopped and locked."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.simulation import Simulation


@pytest.fixture
def arm() -> Iterator[Simulation]:
    simulation = Simulation()
    simulation.create_world()
    simulation.add_robot("so100")
    yield simulation
    simulation.cleanup()


def test_an_arm_is_driven_watched_and_stopped_over_the_mesh(peers: Fleet, arm: Simulation) -> None:
    states: list[dict[str, Any]] = []
    peers.stranger().declare_subscriber("strands/sim-1/state", lambda sample: states.append(json.loads(sample.payload)))
    peers.join(arm, "sim-1", "sim")
    console = peers.join(None, "console")
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 120}
    assert console.send("sim-1", start, timeout=20)["result"]["status"] == "success"
    eventually(lambda: states and states[-1].get("robots") == {"so100": True})
    eventually(lambda: any(joint["velocity"] for joint in states[-1]["joints"].values()))
    assert console.send("sim-1", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    assert arm.list_policies_running() == []
    console.emergency_stop()
    assert console.send("sim-1", start, timeout=20)["error"] == "command rejected"
    assert arm.start_policy("so100", "wave")["status"] == "error"


def test_execute_returns_when_the_task_is_completed(peers: Fleet, arm: Simulation) -> None:
    peers.join(arm, "sim-1", "sim")
    console = peers.join(None, "console")
    reply = console.tell("sim-1", "wave", policy_provider="mock", duration=0.5)
    assert reply["result"]["status"] == "success"
    assert reply["result"]["state"] == "completed"
    assert reply["result"]["step_count"] >= 1
    assert arm.list_policies_running() == []


def test_unknown_provider_is_refused_by_the_robot(peers: Fleet, arm: Simulation) -> None:
    peers.join(arm, "sim-1", "sim")
    console = peers.join(None, "console")
    reply = console.send("sim-1", {"action": "start", "instruction": "x", "policy_provider": "groot"}, timeout=20)
    assert reply["type"] == "response"
    assert reply["result"]["status"] == "error"


def test_rollout_steps_are_published_without_a_request(peers: Fleet, arm: Simulation) -> None:
    steps: list[dict[str, Any]] = []
    mesh = peers.join(arm, "sim-1", "sim")
    console = peers.join(None, "console")
    console.on_stream("sim-1", lambda key, data: steps.append(data))
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 120}
    assert console.send("sim-1", start, timeout=20)["result"]["status"] == "success"
    eventually(lambda: len(steps) > 5)
    first = steps[0]
    assert set(first) == {"peer_id", "step", "t", "instruction", "policy", "observation", "action"}
    assert (first["peer_id"], first["instruction"], first["policy"]) == ("sim-1", "wave", "mock")
    assert set(first["observation"]) == set(arm.get_observation())
    assert set(first["action"]) <= set(arm.get_features()["robots"]["so100"]["action_features"])
    assert [body["step"] for body in steps] == sorted({body["step"] for body in steps})
    mesh.stop()
    published = len(steps)
    assert arm.list_policies_running(), "leaving the mesh ends no rollout"
    eventually(lambda: arm.list_policies_running()[0]["step"] > first["step"] + 20)
    assert len(steps) == published


def test_simulated_robot_publishes_its_pose(peers: Fleet, arm: Simulation) -> None:
    poses: list[dict[str, Any]] = []
    peers.stranger().declare_subscriber("strands/sim-1/pose", lambda sample: poses.append(json.loads(sample.payload)))
    peers.join(arm, "sim-1", "sim")
    console = peers.join(None, "console")
    eventually(lambda: poses)
    assert set(poses[0]) == {"peer_id", "t", "x", "y", "z", "theta", "quat", "source", "frame"}
    eventually(lambda: (console.get_peer("sim-1") or {}).get("topics") == ["health", "pose"])
