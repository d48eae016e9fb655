"""One description of a verb holds its RPC, its schema, the mesh's validation and the agent tool."""

from __future__ import annotations

import inspect
import math
from typing import Any

import pytest

from strands_robots.device_connect.reachy_mini_driver import ReachyMiniDriver
from strands_robots.device_connect.robot_driver import (
    MobileBaseDeviceDriver,
    NavigatingBaseDeviceDriver,
    RobotDeviceDriver,
)
from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.mesh.security import validate_command
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, PICTURE_VERBS
from strands_robots.serving.control_leases import CONTROL_VERBS
from strands_robots.serving.peer_verbs import KINDS, PEER_VERBS
from strands_robots.serving.robot_verbs import TASK_VERBS, WORLD_VERBS
from strands_robots.serving.verbs import REQUIRED, Kind, Parameter, Verb
from strands_robots.tools import robot_mesh
from strands_robots.utils import ValidationError, whole

REACHY_MOTIONS = {
    *("look", "antennas", "body", "nod", "shake", "happy", "wakeUp", "sleep", "playMove"),
    *("enableMotors", "disableMotors"),
}

DRIVERS = (
    RobotDeviceDriver,
    SimulationDeviceDriver,
    ReachyMiniDriver,
    MobileBaseDeviceDriver,
    NavigatingBaseDeviceDriver,
)


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.__name__)
def test_every_described_verb_is_an_rpc_with_the_described_signature(driver: Any) -> None:
    for name, verb in driver.verbs.items():
        _, *parameters = inspect.signature(getattr(driver, name)).parameters.values()
        assert [each.name for each in parameters] == list(verb.by_name), name
        for parameter, described in zip(parameters, verb.parameters, strict=True):
            wanted = inspect.Parameter.empty if described.default is REQUIRED else described.default
            assert parameter.default == wanted, (name, described.name)
            assert parameter.annotation is described.type, (name, described.name)


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.__name__)
def test_every_rpc_of_a_driver_is_a_described_verb(driver: Any) -> None:
    rpcs = {name for name in dir(driver) if getattr(getattr(driver, name, None), "_is_device_function", False)}
    assert rpcs == set(driver.verbs)


@pytest.mark.parametrize("verb", [v for driver in DRIVERS for v in driver.verbs.values()], ids=lambda verb: verb.name)
def test_a_default_is_inside_the_domain_of_its_parameter(verb: Verb) -> None:
    for each in verb.parameters:
        if each.default is not REQUIRED:
            each.check(each.name, each.default)


def test_the_agent_tool_describes_a_task_as_execute_does() -> None:
    page = inspect.getdoc(inspect.unwrap(getattr(robot_mesh, "_tool_func", robot_mesh)))
    assert page is not None
    for name in ("instruction", "policy_provider", "duration"):
        described = " ".join(TASK_VERBS["execute"].by_name[name].meaning.split())
        assert described.lower() in " ".join(page.split()).lower(), name


def test_the_mesh_knows_the_documented_actions() -> None:
    assert set(PEER_VERBS) == {
        *("status", "stop", "features", "state", "execute", "start", "step", "reset"),
        *("teleop_status", "teleop_receive", "teleop_stop", "releaseTorque", "resume", "ping", "describe"),
        *ARM_MOTION_VERBS,
        *PICTURE_VERBS,
        *("lead", "leadTo"),
        *CONTROL_VERBS,
        *("drive", "navigateTo"),
        *REACHY_MOTIONS,
        *("getDaemonStatus", "getJoints", "getImu", "listMoves"),
    }
    moving = {name for name, verb in PEER_VERBS.items() if verb.kind is Kind.MOTION}
    arm = {"moveJoints", "moveTo", "moveBy", "setGripper", "goTo", "savePlace", "pick", "place"}
    world = {"execute", "start", "step", "reset", "teleop_receive", "lead", "releaseTorque", "acquireControl"}
    assert moving == world | arm | {"drive", "navigateTo"} | REACHY_MOTIONS


@pytest.mark.parametrize(
    ("kind", "driver"),
    [
        ("reachy_mini", ReachyMiniDriver),
        ("mobile_base", MobileBaseDeviceDriver),
        ("navigating_base", NavigatingBaseDeviceDriver),
    ],
)
def test_every_kind_of_robot_has_its_motions_on_the_mesh_as_on_device_connect(kind: str, driver: Any) -> None:
    own = {name for name, verb in driver.verbs.items() if verb.kind is Kind.MOTION} - set(TASK_VERBS)
    assert own
    assert own <= set(KINDS[kind]) <= set(PEER_VERBS)
    for name in own:
        assert list(PEER_VERBS[name].by_name) == list(driver.verbs[name].by_name), name


def test_the_mesh_fills_in_defaults_and_leaves_out_what_is_none() -> None:
    command = {"action": "start", "policy_provider": "mock", "robot_name": None}
    assert validate_command(command) == {
        "action": "start",
        "policy_provider": "mock",
        "duration": 30.0,
        "policy_host": "localhost",
    }


MISREAD = {
    "durration": 0.5,
    "n_step": 3,
    "embodiment": "so100",
    "fast_mode": True,
    "trust_remote_code": True,
    "server_address": "localhost:8080",
    "model_path": "act",
    "policy_host_": "localhost",
    "": 1,
    "a b\n": 1,
}
"""Fields that would change a motion, and that no verb of ours reads."""

TASKS = [PEER_VERBS["execute"], PEER_VERBS["start"], TASK_VERBS["execute"]]


@pytest.mark.parametrize("verb", TASKS, ids=["mesh execute", "mesh start", "Device Connect execute"])
@pytest.mark.parametrize("name", MISREAD)
def test_a_field_that_a_motion_does_not_read_is_refused_by_name(verb: Verb, name: str) -> None:
    with pytest.raises(ValidationError) as refused:
        verb.checked({"instruction": "wave", "policy_provider": "mock", name: MISREAD[name]})
    assert f"it has no {name if name.isidentifier() else repr(name)}" in str(refused.value)


@pytest.mark.parametrize("verb", [*PEER_VERBS.values(), *TASK_VERBS.values()], ids=lambda verb: verb.name)
def test_every_motion_refuses_what_it_does_not_read_and_no_read_or_stop_does(verb: Verb) -> None:
    given = {each.name: "" for each in verb.parameters if each.default is REQUIRED} | {"durration": 0.5}
    if verb.kind is Kind.MOTION:
        with pytest.raises(ValidationError, match="durration"):
            verb.checked(given)
    elif verb.kind is Kind.READ:
        assert "durration" not in verb.checked(given)
    elif verb.kind is Kind.STOP:
        assert "durration" not in verb.readable(given)[0]


@pytest.mark.parametrize(("name", "meant"), [("durration", "duration"), ("n_step", "n_steps")])
def test_the_refusal_says_which_argument_may_have_been_meant(name: str, meant: str) -> None:
    with pytest.raises(ValidationError, match=rf"{name} \(did you mean {meant}\?\)"):
        PEER_VERBS["start"].checked({"policy_provider": "mock", name: 1})


def test_a_thousand_unknown_arguments_make_a_short_refusal() -> None:
    many = {f"speed_{number}": 1 for number in range(1000)}
    with pytest.raises(ValidationError, match="and 995 more") as refused:
        PEER_VERBS["start"].checked({"policy_provider": "mock", **many})
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize(
    "sent",
    [
        {"_dc_meta": {"source_device": "console"}},
        {"turn_id": "t-1", "sender_id": "console", "action": "execute"},
        {"world_update": None, "model_path": None},
        {"policy_host": "localhost"},
    ],
    ids=lambda sent: next(iter(sent)),
)
def test_a_motion_takes_the_fields_that_frameworks_and_peers_of_0_5_3_send(sent: dict[str, Any]) -> None:
    for verb in TASKS:
        checked = verb.checked({"instruction": "wave", "policy_provider": "mock", **sent})
        assert checked["duration"] == 30.0
        assert checked.keys() <= verb.by_name.keys()


def test_a_step_of_0_5_3_without_a_number_is_one_step_on_both_networks() -> None:
    assert WORLD_VERBS["step"].checked({"steps": 1})["n_steps"] == 1
    with pytest.raises(ValidationError, match=r"no steps \(did you mean n_steps\?\)"):
        WORLD_VERBS["step"].checked({"steps": 10})
    with pytest.raises(ValidationError, match="no steps"):
        WORLD_VERBS["step"].checked({"steps": True})


@pytest.mark.parametrize("name", ["n_steps", "policy_port", "action_horizon"])
def test_an_integral_float_is_the_integer_of_a_command(name: str) -> None:
    start = PEER_VERBS["start"]
    checked = start.checked({"policy_provider": "mock", name: 4.0})
    assert (checked[name], type(checked[name])) == (4, int)
    for value in (2.5, True, "4"):
        with pytest.raises(ValidationError, match=name):
            start.checked({"policy_provider": "mock", name: value})


@pytest.mark.parametrize("name", ["target_velocity", "target_joints"])
@pytest.mark.parametrize("empty", [[], {}, ()])
def test_an_empty_goal_is_refused_by_name(name: str, empty: object) -> None:
    with pytest.raises(ValidationError, match=f"{name} must be 1 to"):
        PEER_VERBS["start"].checked({"policy_provider": "mock", name: empty})


GO = Verb(
    "go",
    Kind.MOTION,
    "Go.",
    (
        Parameter("steps", int, "Steps", lambda name, value: whole(name, value, low=1, high=9)),
        Parameter("turns", int, "Turns", lambda name, value: whole(name, value, low=0, high=9), default=2),
    ),
)


def test_checked_arguments_have_their_defaults() -> None:
    assert GO.checked({"steps": 3}) == {"steps": 3, "turns": 2, "lease_id": "", "lease_ttl_s": 0.0}


@pytest.mark.parametrize(
    ("given", "names"),
    [({}, "steps is missing"), ({"steps": 1, "speed": 1}, "it has no speed"), ({"steps": 10}, "steps must be")],
)
def test_arguments_that_do_not_fit_are_refused_by_name(given: dict[str, Any], names: str) -> None:
    with pytest.raises(ValidationError, match=names):
        GO.checked(given)


@pytest.mark.parametrize("value", [True, 1.0, math.nan, "1", None])
def test_booleans_and_floats_are_no_whole_numbers(value: Any) -> None:
    with pytest.raises(ValidationError, match="steps must be"):
        GO.checked({"steps": value})
