"""A call of a function, as 0.5 releases send it, is a command of the verb of that name."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh.security import ValidationError, validate_command
from strands_robots.mesh.transport import Sample
from strands_robots.mesh.wire import encode


def answer(peers: Fleet, target: str, command: dict[str, Any]) -> dict[str, Any]:
    console = peers.join(None, "console")
    reply = console.send(target, command, timeout=20)
    assert reply["type"] == "response", reply
    return dict(reply["result"])


@pytest.mark.parametrize(("action", "field"), [("call", "function"), ("sim_call", "sim_action")])
def test_called_function_is_the_verb_of_its_name(peers: Fleet, action: str, field: str) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    params = {"instruction": "wave", "policy_provider": "mock"}
    assert answer(peers, "sim-1", {"action": action, field: "start_policy", "params": params})["status"] == "success"
    assert world.running == {"left": "wave"}


def test_called_stop_is_a_stop(peers: Fleet) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    world.start_policy("left", "wave")
    assert answer(peers, "sim-1", {"action": "call", "function": "stop"})["ok"] is True
    assert world.running == {}


@pytest.mark.parametrize("function", ["stop", "stop_policy", "stop_task", "stop_motion", "halt"])
@pytest.mark.parametrize("params", [None, [1], "left", {"robot_name": 5}, {"robot_name": "left", "now": float("nan")}])
@pytest.mark.parametrize("retained", [False, True])
def test_called_stop_is_refused_for_nothing(peers: Fleet, function: str, params: Any, retained: bool) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    world.start_policy("left", "wave")
    command = {"action": "call", "function": function, "params": params}
    if retained:
        body = {"sender_id": "other", "turn_id": "t1", "timestamp": peers.clock(), "command": command}
        peers.bus.deliver(peers.stranger(), Sample("strands/sim-1/cmd", encode(body, 10_000), "other", retained=True))
        assert eventually(lambda: peers.events("command_executed"))
    else:
        assert answer(peers, "sim-1", command)["ok"] is True
    assert world.running == {}


def test_function_may_be_named_as_its_method(peers: Fleet) -> None:
    peers.join(World("left"), "sim-1", "sim")
    assert "robots" in answer(peers, "sim-1", {"action": "call", "function": "get_state"})
    assert "status" in answer(peers, "sim-1", {"action": "call", "function": "get_control", "params": {}})


def test_description_of_a_tool_is_the_verbs(peers: Fleet) -> None:
    peers.join(World("left"), "sim-1", "sim")
    names = [each["name"] for each in answer(peers, "sim-1", {"action": "describe_tool"})["functions"]]
    assert {"start", "stop", "status"} <= set(names)


def test_called_motion_of_real_hardware_needs_what_every_motion_needs(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    params = {"instruction": "wave", "policy_provider": "mock"}
    reply = console.send("arm-1", {"action": "call", "function": "start", "params": params}, timeout=20)
    assert reply["type"] == "error"
    assert "moves real hardware" in reply["error"]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ({"action": "set_joints", "target_joints": {"pan": 0.5}}, "Use moveJoints"),
        ({"action": "call", "function": "add_object"}, "function 'add_object' is no verb of this peer"),
        ({"action": "call", "function": "call"}, "is no verb of this peer"),
        ({"action": "sim_call", "sim_action": "never_was", "params": {}}, "describe lists its verbs"),
    ],
    ids=lambda value: value["action"] if isinstance(value, dict) else None,
)
def test_what_is_not_served_says_what_to_use(peers: Fleet, command: dict[str, Any], words: str) -> None:
    peers.join(World("left"), "sim-1", "sim")
    refused = answer(peers, "sim-1", command)
    assert refused["status"] == "error"
    assert words in refused["reason"]


@pytest.mark.parametrize(
    "command",
    [
        {"action": "call"},
        {"action": "call", "function": 5},
        {"action": "call", "function": "x" * 65},
        {"action": "sim_call", "sim_action": "step", "params": [1]},
        {"action": "call", "function": "step", "params": {"steps": float("nan")}},
    ],
)
def test_call_that_names_nothing_is_refused_before_it_is_sent(command: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        validate_command(command)


def test_params_of_a_call_that_are_no_object_are_refused(peers: Fleet) -> None:
    peers.join(World("left"), "sim-1", "sim")
    stranger = peers.stranger()
    body = {"sender_id": "other", "turn_id": "t1", "timestamp": peers.clock(), "command": {"action": "call"}}
    stranger.put("strands/sim-1/cmd", body)
    assert peers.events("command_refused")[-1]["action"] == "call"
