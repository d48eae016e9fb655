from __future__ import annotations

import base64
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fixtures.barista import Barista
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.fleet.scripted import ScriptedNetwork, function

from strands_robots import settings
from strands_robots.envelope import error, success
from strands_robots.errors import UnknownVerbError, UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.mesh import network
from strands_robots.fleet.networks import Networks
from strands_robots.mesh import Mesh, init_mesh, safety
from strands_robots.mesh.session import clear_peers
from strands_robots.mesh.transport import config
from strands_robots.safety.plane import plane
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.tools import robot_mesh

# The package gives the tool for the module's name.
MODULE = sys.modules["strands_robots.tools.robot_mesh"]


def use(monkeypatch: pytest.MonkeyPatch, *networks: ScriptedNetwork) -> None:
    """Have the tool join these networks."""
    for make in ("networks_of", "networks_for_stop"):
        monkeypatch.setattr(MODULE, make, lambda *_, **__: Networks(networks))


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> ScriptedNetwork:
    network = ScriptedNetwork(robots=dict.fromkeys(("arm-1", "base-1", "world-1")))
    use(monkeypatch, network)
    return network


def test_every_action_reaches_the_network(fake: ScriptedNetwork) -> None:
    assert [row["id"] for row in robot_mesh(action="peers")["peers"]] == ["arm-1", "base-1", "world-1"]
    robot_mesh(action="tell", target="arm-1", instruction="wave", duration=2)
    robot_mesh(action="status", target="arm-1")
    robot_mesh(action="release_torque", target="arm-1")
    task = {"instruction": "wave", "policy_provider": "mock", "duration": 2.0}
    assert fake.calls == [
        ("arm-1", "execute", task, 10.0),
        ("arm-1", "getStatus", {}, 10.0),
        ("arm-1", "releaseTorque", {}, 10.0),
    ]
    robot_mesh(action="stop", target="arm-1")
    robot_mesh(action="stop", target="world-1", arguments={"robot_name": "left"})
    robot_mesh(action="stop")
    assert fake.stopped == ["arm-1", "world-1/left", "arm-1", "base-1", "world-1"]
    robot_mesh(action="emergency_stop", instruction="smoke")
    assert [(reason, scope) for reason, scope, _ in fake.estops] == [("smoke", EVERY_ROBOT)]
    assert not fake.joined


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"action": "dance"}, "action"),
        ({"action": "tell", "instruction": "wave"}, "target"),
        ({"action": "tell", "target": "arm/1", "instruction": "wave"}, "target"),
        ({"action": "tell", "target": "arm-1"}, "instruction"),
        ({"action": "tell", "target": "arm-1", "instruction": "a\x00b"}, "instruction"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "duration": float("nan")}, "duration"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "duration": 1e9}, "duration"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "policy_provider": ""}, "policy_provider"),
        ({"action": "ping"}, "target"),
        ({"action": "send", "command": '{"action": "status"}'}, "target"),
        ({"action": "send", "target": "arm-1"}, "arguments action"),
        ({"action": "send", "target": "arm-1", "command": "{no json"}, "arguments"),
        ({"action": "send", "target": "arm-1", "command": '{"action": [1]}'}, "arguments action"),
        ({"action": "broadcast", "command": '{"action": "execute", "instruction": "wave"}'}, "arguments action"),
        ({"action": "rpc", "target": "arm-1"}, "verb"),
        ({"action": "rpc", "target": "arm-1", "function": "nod", "command": "[1]"}, "arguments"),
        ({"action": "status", "target": "arm-1", "timeout": 0}, "timeout"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "timeout": float("nan")}, "timeout"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "policy_port": 70000}, "policy_port"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "arguments": {"speed": 9}}, "speed"),
        *(({"action": action, "target": "arm-1"}, "status says") for action in ("subscribe", "watch", "inbox")),
        ({"action": "move", "arguments": {"x": 1}}, "target"),
        ({"action": "call", "target": "arm-1"}, "verb"),
        ({"action": "call", "target": "arm-1", "verb": "a/b"}, "verb"),
        ({"action": "move", "target": "arm-1", "arguments": [1]}, "arguments"),
        ({"action": "release_torque"}, "target"),
    ],
)
def test_argument_out_of_its_domain_is_refused_by_name(
    fake: ScriptedNetwork, arguments: dict[str, Any], named: str
) -> None:
    answer = robot_mesh(**arguments)
    assert answer["status"] == "error"
    assert named in answer["reason"]
    assert fake.calls == []
    assert fake.searches == 0


def test_actions_of_the_older_tool_reach_the_network(fake: ScriptedNetwork) -> None:
    """As strands-robots 0.5 was called: without a tool context, with its names, and with what it ignored."""
    older: dict[str, Any] = {"tool_context": None, "name": "", "limit": 50, "function": "", "command": ""}
    assert len(robot_mesh(action="status", **older)["peers"]) == 3
    robot_mesh(action="tell", target="arm-1", instruction="wave", duration=2, policy_port=5555, timeout=7.0)
    robot_mesh(action="send", target="arm-1", **{**older, "command": '{"action": "status"}'})
    robot_mesh(action="send", target="arm-1", command='{"action": "start", "instruction": "wave", "durration": 2}')
    robot_mesh(action="rpc", target="arm-1", function="nod", command='{"times": 2}', timeout=3.0)
    assert robot_mesh(action="ping", target="arm-1")["latency_ms"] >= 0
    task = {"instruction": "wave", "policy_provider": "mock", "duration": 2.0, "policy_port": 5555}
    # What a verb takes is checked by its robot, which refuses the misspelt duration by name.
    sent = {"instruction": "wave", "durration": 2}
    assert fake.calls == [
        ("arm-1", "execute", task, 7.0),
        ("arm-1", "getStatus", {}, MODULE.CALL_S),
        ("arm-1", "execute", sent, MODULE.CALL_S),
        ("arm-1", "nod", {"times": 2}, 3.0),
        ("arm-1", "getStatus", {}, 10.0),
    ]


def test_broadcast_asks_every_robot_and_names_those_without_an_answer(fake: ScriptedNetwork) -> None:
    answer = robot_mesh(action="broadcast", command='{"action": "status", "extra": 1}', name="n", limit=3)
    assert [row["robot_id"] for row in answer["responses"]] == ["arm-1", "base-1", "world-1"]
    assert {call[:2] for call in fake.calls} == {(name, "getStatus") for name in ("arm-1", "base-1", "world-1")}
    fake.answers["getState"] = UnreachableError("base-1 is away")
    answer = robot_mesh(action="broadcast", arguments={"action": "state"})
    assert answer["status"] == "error"
    assert "0 of 3 robots answered state. No answer: arm-1, base-1, world-1." in answer["reason"]


@pytest.mark.parametrize(
    ("given", "stopped"),
    [
        ({"action": "send", "target": "arm-1", "command": '{"action": "stop"}'}, ["arm-1"]),
        ({"action": "send", "target": "a b", "command": {"action": "stop", "x": 1}}, ["arm-1", "base-1", "world-1"]),
        ({"action": "send", "command": '{"action": "stop"}', "timeout": -1}, ["arm-1", "base-1", "world-1"]),
        ({"action": "broadcast", "target": "arm-1", "command": '{"action": "stop"}'}, ["arm-1", "base-1", "world-1"]),
        ({"action": "send", "target": "arm-1", "command": "stop"}, ["arm-1"]),
        ({"action": "send", "target": "arm-1", "arguments": '{"action": "stop"}'}, ["arm-1"]),
    ],
)
async def test_stop_that_is_sent_or_broadcast_is_a_stop(
    fake: ScriptedNetwork, given: dict[str, Any], stopped: list[str]
) -> None:
    assert robot_mesh(**given)["stopped"] is True
    assert fake.stopped == stopped
    fake.stopped.clear()
    use = {"toolUseId": "1", "name": "robot_mesh", "input": given}
    events = [event async for event in robot_mesh.stream(use, {})]
    assert fake.stopped == stopped, events


@pytest.mark.parametrize(
    ("given", "scope"),
    [
        ({"action": "broadcast", "target": "arm-1", "command": '{"action": "emergency_stop"}'}, EVERY_ROBOT),
        ({"action": "send", "target": "arm-1", "command": "emergency_stop"}, Scope(frozenset({"arm-1"}))),
    ],
)
async def test_emergency_stop_that_is_sent_or_broadcast_is_one(
    fake: ScriptedNetwork, given: dict[str, Any], scope: Scope
) -> None:
    use = {"toolUseId": "1", "name": "robot_mesh", "input": given}
    events = [event async for event in robot_mesh.stream(use, {})]
    assert [said for _, said, _ in fake.estops] == [scope], events


@pytest.mark.parametrize("action", ["call", "rpc"])
@pytest.mark.parametrize(
    "given", [{"timeout": -1}, {"timeout": "soon"}, {"arguments": "[1]"}, {"arguments": {"now": object()}}, {"x": []}]
)
def test_no_argument_refuses_a_stop_that_is_called(fake: ScriptedNetwork, action: str, given: dict[str, Any]) -> None:
    robot_mesh(action=action, target="arm-1", **{"verb": "stop", **given})
    assert fake.calls == [("arm-1", "stop", {}, MODULE.STOP_S)]


async def test_agent_reaches_a_verb_by_the_older_names(fake: ScriptedNetwork) -> None:
    given = {"action": "rpc", "target": "arm-1", "function": "nod", "command": '{"times": 2}'}
    use = {"toolUseId": "1", "name": "robot_mesh", "input": given}
    events = [event async for event in robot_mesh.stream(use, {})]
    assert [call[:3] for call in fake.calls] == [("arm-1", "nod", {"times": 2})], events


def test_schema_has_one_name_for_each_meaning() -> None:
    names = set(robot_mesh.tool_spec["inputSchema"]["json"]["properties"])
    assert not names & {"command", "function", "limit", "name", "tool_context", "policy_port"}


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({}, ""),
        ({"instruction": "x" * 100_000}, "x" * 200),
        ({"instruction": "a\nb", "duration": "?"}, "a b"),
        ({"instruction": 5, "target": "a b"}, "5"),
    ],
)
async def test_no_argument_refuses_an_emergency_stop(fake: ScriptedNetwork, given: dict[str, Any], reason: str) -> None:
    use = {"toolUseId": "1", "name": "robot_mesh", "input": {"action": "emergency_stop", **given}}
    events = [event async for event in robot_mesh.stream(use, {})]
    assert [(said, scope) for said, scope, _ in fake.estops] == [(reason, EVERY_ROBOT)], events


@pytest.mark.parametrize(
    ("given", "stopped"),
    [
        ({"target": "arm 1"}, ["arm-1", "base-1", "world-1"]),
        ({"target": ["arm-1"], "reason": "x"}, ["arm-1", "base-1", "world-1"]),
        ({"arguments": {"robot_name": "left"}}, ["arm-1", "base-1", "world-1"]),
        ({"target": "world-1", "arguments": {"robot": "left"}}, ["world-1"]),
        ({"target": "world-1", "arguments": {"robot_name": ""}}, ["world-1"]),
        ({"target": "world-1", "arguments": {"robot_name": [1]}}, ["world-1"]),
        ({"target": "world-1", "arguments": "left"}, ["world-1"]),
        ({"target": "world-1", "arguments": {"robot_name": "left"}}, ["world-1/left"]),
    ],
)
async def test_no_argument_refuses_a_stop(fake: ScriptedNetwork, given: dict[str, Any], stopped: list[str]) -> None:
    use = {"toolUseId": "1", "name": "robot_mesh", "input": {"action": "stop", **given}}
    events = [event async for event in robot_mesh.stream(use, {})]
    assert fake.stopped == stopped, events


def test_verbs_are_called_with_their_arguments(fake: ScriptedNetwork) -> None:
    robot_mesh(action="move", target="arm-1", arguments={"x": 0.2, "y": 0.0, "z": 0.1})
    robot_mesh(action="move", target="arm-1", verb="pick", arguments={"object": "cube"})
    robot_mesh(action="call", target="base-1", verb="drive", arguments={"linear": 0.1})
    robot_mesh(action="wait", target="arm-1")
    assert [call[:3] for call in fake.calls] == [
        ("arm-1", "moveTo", {"x": 0.2, "y": 0.0, "z": 0.1}),
        ("arm-1", "pick", {"object": "cube"}),
        ("base-1", "drive", {"linear": 0.1}),
        ("arm-1", "wait", {}),
    ]


def test_picture_is_an_image_block(fake: ScriptedNetwork) -> None:
    answer = success("front, 2 x 2 pixels.", camera="front") | {"jpeg": base64.b64encode(b"\xff\xd8x").decode()}
    fake.answers["getPicture"] = lambda _: answer
    shown = robot_mesh(action="picture", target="arm-1", arguments={"camera": "front"})
    assert shown["content"][-1] == {"image": {"format": "jpeg", "source": {"bytes": b"\xff\xd8x"}}}
    assert "jpeg" not in shown
    answer["jpeg"] = "no base64!"
    assert "could not be decoded" in robot_mesh(action="picture", target="arm-1")["reason"]


def test_picture_of_a_motion_is_an_image_block_of_its_answer(fake: ScriptedNetwork) -> None:
    taken = {"camera": "table", "format": "jpeg", "jpeg": base64.b64encode(b"\xff\xd8x").decode()}
    answer = success("moveTo completed.", error_mm=0.4) | {"picture": taken}
    fake.answers["moveTo"] = lambda _: answer
    shown = robot_mesh(action="move", target="arm-1", arguments={"x": 0.2, "y": 0.0, "z": 0.1, "picture": "table"})
    assert shown["content"][-1] == {"image": {"format": "jpeg", "source": {"bytes": b"\xff\xd8x"}}}
    assert shown["error_mm"] == 0.4
    assert "picture" not in shown


@pytest.mark.parametrize(
    ("value", "devices"),
    [("off", False), ("OFF", False), ("0", False), ("false", False)]
    + [(each, True) for each in ("auto", "on", "", "maybe")],
)
def test_device_connect_is_left_out_where_the_setting_says_so(
    monkeypatch: pytest.MonkeyPatch, value: str, devices: bool
) -> None:
    made: list[bool] = []

    def networks_of(*_: object, devices: bool) -> Networks:
        made.append(devices)
        return Networks([ScriptedNetwork()])

    for make in ("networks_of", "networks_for_stop"):
        monkeypatch.setattr(MODULE, make, networks_of)
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", value)
    for action in ("peers", "stop", "emergency_stop"):
        robot_mesh(action=action)
    assert made == [devices] * 3


@pytest.fixture
def on_the_mesh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    monkeypatch.setattr(config, "DISCOVERY_S", 0.1)
    monkeypatch.setattr(MODULE, "STOP_S", 20.0)
    monkeypatch.setattr(safety, "COLLECT_S", 20.0)
    clear_peers()
    yield
    clear_peers()


def test_every_action_on_an_empty_mesh_is_an_error(on_the_mesh: None) -> None:
    for arguments in ({"action": "peers"}, {"action": "stop"}, {"action": "emergency_stop"}):
        assert robot_mesh(**arguments)["status"] == "error"


def test_answer_without_robots_names_where_they_were_looked_for(on_the_mesh: None) -> None:
    told = robot_mesh(action="peers")["content"][0]["text"]
    assert told == "No robot answered. They were looked for on the native mesh."


def test_disabled_mesh_is_reported_as_off(on_the_mesh: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH", "false")
    answer = robot_mesh(action="stop")
    assert "mesh: it is switched off" in answer["reason"]
    assert answer["stopped"] is None


def test_robots_on_the_mesh_are_listed_commanded_and_stopped(on_the_mesh: None) -> None:
    left, stuck = World("left"), Arm("stuck", stops=False)
    meshes = [init_mesh(left, "sim-1", "sim"), init_mesh(stuck, "arm-1")]
    try:
        # All peers of one process share their list of peers, so the tool knows whom any of them has seen.
        names = {"sim-1", "arm-1"}
        eventually(lambda: {row["peer_id"] for mesh in meshes if mesh is not None for row in mesh.peers} == names)
        assert {row["id"] for row in robot_mesh(action="peers")["peers"]} == names
        assert robot_mesh(action="tell", target="sim-1", instruction="wave")["status"] == "success"
        assert left.running == {"left": "wave"}
        assert robot_mesh(action="status", target="sim-1")["task_status"] == "running"
        assert robot_mesh(action="stop", target="sim-1")["stopped"] is True
        assert "operator approval" in robot_mesh(action="tell", target="arm-1", instruction="wave")["reason"]
        verdict = robot_mesh(action="emergency_stop")
        assert verdict["status"] == "error"
        assert verdict["not_stopped"] == ["arm-1"]
        assert meshes[0] is not None and meshes[0].lockout_epoch == verdict["estop_id"]
    finally:
        for mesh in meshes:
            if mesh is not None:
                mesh.close()


@pytest.fixture
def barista(on_the_mesh: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Barista]:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    robot = Barista()
    with ExitStack() as stack:
        peers = [init_mesh(body, name) for body, name in ((robot, "bar-1"), (None, "looker"))]
        for each in peers:
            assert each is not None
            stack.callback(each.close)
        # All peers of one process share their list of peers.
        eventually(lambda: peers[1] is not None and peers[1].get_peer("bar-1") is not None)
        yield robot


def test_own_verb_of_a_mesh_peer_is_waited_for_as_long_as_it_lasts(
    barista: Barista, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MODULE, "CALL_S", 1e-6)
    answer = robot_mesh(action="call", target="bar-1", verb="brewCoffee", arguments={"cups": 2})
    assert answer["cups"] == 2


def test_silent_peer_of_the_mesh_is_named(barista: Barista, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Mesh, "send", lambda *_: {"status": "timeout"})
    assert robot_mesh(action="status", target="bar-1")["reason"].startswith("bar-1 did not answer.")


def test_refusal_of_a_peer_of_the_mesh_keeps_its_words(barista: Barista, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Mesh, "send", lambda *_: {"type": "error", "error": "validation: cups is missing."})
    assert robot_mesh(action="status", target="bar-1")["reason"] == "bar-1: validation: cups is missing."


def test_peers_of_the_mesh_are_listed_with_the_verbs_that_they_have(barista: Barista) -> None:
    (bar,) = (row for row in robot_mesh(action="peers")["peers"] if row["id"] == "bar-1")
    assert {"brewCoffee", "beansLeft", "status", "stop"} <= set(bar["functions"])
    assert not {"moveTo", "execute", "releaseTorque"} & set(bar["functions"])
    assert bar["own_verbs"]["brewCoffee"].startswith("(cups: integer, 1 to 8; [strength: mild | strong]) Brew coffee")
    assert "note" not in bar


@pytest.mark.parametrize("verb", ["brewCoffee", "status", "stop"])
def test_unknown_peer_is_answered_at_once_with_the_near_ones(
    barista: Barista, verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network, "STOP_S", 0.1)
    answer = robot_mesh(action="call", target="bar-2", verb=verb)
    assert answer["reason"] == "No peer 'bar-2' is on the mesh. Near it: bar-1."


def test_remote_network_needs_an_opt_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NATS_URL", "nats://192.0.2.1:4222")
    answer = robot_mesh(action="status", target="arm-1")
    assert answer["status"] == "error"
    assert "needs authentication" in answer["reason"]
    assert "insecure" in answer["reason"]


def test_network_that_cannot_be_used_refuses_no_stop_on_the_other(
    on_the_mesh: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STRANDS_ROBOT_MESH_DC")
    monkeypatch.setenv("NATS_URL", "nats://192.0.2.1:4222")
    robot = World("left")
    peer = init_mesh(robot, "sim-1", "sim")
    assert peer is not None
    try:
        for action in ("stop", "emergency_stop"):
            robot.start_policy("left", "wave")
            answer = robot_mesh(action=action)
            assert robot.running == {}
            # What is on the other network is not known.
            assert (answer["status"], answer["stopped"]) == ("error", None)
            assert "Stopped: sim-1." in answer["reason"]
            assert "It did not leave on device_connect: A network beyond this machine" in answer["reason"]
            plane().clear_local("the test")
    finally:
        peer.close()


def test_importing_the_tools_loads_no_agent_framework() -> None:
    code = "import sys, strands_robots.tools; assert not {'strands', 'zenoh', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_missing_strands_agents_names_the_extra_in_one_sentence() -> None:
    code = (
        "import sys; sys.modules['strands'] = None\n"
        "try:\n    from strands_robots.tools import robot_mesh\n"
        "except ImportError as exc:\n    print(exc)"
    )
    output = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert "'.[agent]'" in output
    assert len(output.splitlines()) == 1


BREW = {
    "name": "brewCoffee",
    "description": "Brew coffee.",
    "parameters": {"properties": {"cups": {"type": "integer", "minimum": 1, "maximum": 8}}, "required": ["cups"]},
    "labels": {"direction": "write", "own": "true", "lasts_s": "90"},
}


RESUME = {"name": "resume", "parameters": {"properties": {"assertion": {"type": "object"}}}}
OURS = (BREW, RESUME, *({"name": f"{name}Control"} for name in ("acquire", "renew", "release")), {"name": "stop"})


@pytest.fixture
def bar(monkeypatch: pytest.MonkeyPatch) -> ScriptedNetwork:
    """A robot with a verb of its own, and a device that is none of ours."""
    network = ScriptedNetwork(robots={"bar-1": OURS, "echo-1": ({"name": "echo"},)})
    use(monkeypatch, network)
    return network


def test_own_verb_is_called_with_its_arguments_for_as_long_as_it_lasts(bar: ScriptedNetwork) -> None:
    robot_mesh(action="call", target="bar-1", verb="brewCoffee", arguments={"cups": 2})
    robot_mesh(action="call", target="bar-1", verb="ownUnknown")
    assert bar.calls == [("bar-1", "brewCoffee", {"cups": 2}, 125.0), ("bar-1", "ownUnknown", {}, 35.0)]


def test_unknown_verb_is_refused_with_those_that_resemble_it(bar: ScriptedNetwork) -> None:
    def unknown(arguments: object) -> dict[str, Any]:
        raise UnknownVerbError("Unknown method: brew_coffee", robot="bar-1", verb="brew_coffee")

    bar.answers["brew_coffee"] = unknown
    answer = robot_mesh(action="call", target="bar-1", verb="brew_coffee", arguments={"cups": 2})
    assert (answer["status"], answer["reason"]) == (
        "error",
        "Unknown method: brew_coffee. Near it: brewCoffee.",
    )


def test_error_without_content_is_an_error_to_the_model(bar: ScriptedNetwork) -> None:
    bar.answers["brewCoffee"] = lambda _: {"status": "error", "error": "resume rejected"}
    answer = robot_mesh(action="call", target="bar-1", verb="brewCoffee", arguments={"cups": 2})
    assert (answer["status"], answer["content"][0]) == ("error", {"text": "resume rejected"})


def test_peers_name_own_verbs_with_their_parameters_and_devices_that_cannot_be_stopped(bar: ScriptedNetwork) -> None:
    ours, echo = robot_mesh(action="peers")["peers"]
    assert ours["functions"][:3] == ["brewCoffee", "resume", "acquireControl"]
    assert ours["own_verbs"] == {"brewCoffee": "(cups: integer, 1 to 8) Brew coffee."}
    assert "note" not in ours
    assert echo["note"] == "This device has no lockout, no lease and no stop."


class TestOfBothNetworks:
    """Each action goes to the network that has the robot; a stop goes to all that have it."""

    @pytest.fixture
    def near(self) -> ScriptedNetwork:
        return ScriptedNetwork(DEVICE_CONNECT, dict.fromkeys(("arm-1", "both")))

    @pytest.fixture
    def far(self, near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch) -> ScriptedNetwork:
        far = ScriptedNetwork(MESH, dict.fromkeys(("arm-2", "both")))
        far.starts, far.reads = "start", {"status": "status"}
        use(monkeypatch, near, far)
        return far

    def test_robots_are_listed_with_their_network(self, far: ScriptedNetwork) -> None:
        rows = {row["id"]: row["network"] for row in robot_mesh(action="peers")["peers"]}
        assert rows == {"arm-1": "device_connect", "arm-2": "mesh", "both": "device_connect"}

    def test_network_that_is_not_reached_is_named_beside_the_robots_of_the_other(self, far: ScriptedNetwork) -> None:
        far.unreachable = "the cable is cut"
        peers = robot_mesh(action="peers")
        assert [row["id"] for row in peers["peers"]] == ["arm-1", "both"]
        assert peers["absent"] == {"mesh": "the cable is cut"}
        for answer in (peers, robot_mesh(action="call", target="arm-9", verb="brewCoffee")):
            assert "Not reached: mesh, the cable is cut." in answer["content"][0]["text"]

    def test_robot_is_asked_and_moved_by_the_words_of_its_network(
        self, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        for name in ("arm-1", "arm-2"):
            assert robot_mesh(action="status", target=name)["status"] == "success"
            assert robot_mesh(action="tell", target=name, instruction="wave")["status"] == "success"
        assert [verb for _, verb, _, _ in near.calls] == ["getStatus", "execute"]
        assert [verb for _, verb, _, _ in far.calls] == ["status", "start"]

    @pytest.mark.parametrize(
        "motion",
        [
            {"action": "tell", "instruction": "wave"},
            {"action": "move", "arguments": {"x": 0.1}},
            {"action": "release_torque"},
            {"action": "call", "verb": "brewCoffee"},
        ],
    )
    def test_motion_of_a_shared_id_is_refused_naming_both_networks(
        self, near: ScriptedNetwork, far: ScriptedNetwork, motion: dict[str, Any]
    ) -> None:
        answer = robot_mesh(target="both", **motion)
        assert "device_connect and mesh both have a robot of this id" in answer["reason"]
        assert {verb for _, verb, _, _ in (*near.calls, *far.calls)} <= {"getStatus", "status"}

    @pytest.mark.parametrize(
        "read",
        [
            {"action": "status"},
            {"action": "picture"},
            {"action": "wait"},
            {"action": "call", "verb": "renewControl"},
            {"action": "call", "verb": "beansLeft"},
        ],
    )
    def test_read_of_a_shared_id_goes_to_the_first_network(
        self, near: ScriptedNetwork, far: ScriptedNetwork, read: dict[str, Any]
    ) -> None:
        near.robots["both"] = far.robots["both"] = (function("beansLeft", "read"),)
        near.answers = dict.fromkeys(("getStatus", "getPicture", "wait", "renewControl"), lambda _: success("done"))
        assert robot_mesh(target="both", **read)["status"] == "success"
        assert (len(near.calls), far.calls) == (1, [])

    def test_stop_goes_to_all_bearers_and_each_has_its_answer(
        self, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        far.stops = error("bus", stopped=False)
        answer = robot_mesh(action="stop", target="both")
        assert (answer["stopped"], answer["not_stopped"]) == (False, ["both on mesh"])
        assert (near.stopped, far.stopped) == (["both"], ["both"])

    @pytest.mark.parametrize("verb", ["stop", "stopMotion"])
    def test_call_of_a_stop_goes_to_all_bearers(self, near: ScriptedNetwork, far: ScriptedNetwork, verb: str) -> None:
        assert robot_mesh(action="call", target="both", verb=verb)["stopped"] is True
        assert (near.stopped, far.stopped) == (["both"], ["both"])

    def test_stop_of_all_is_one_answer_that_names_robots_of_both(
        self, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        for action in ("stop", "emergency_stop"):
            answer = robot_mesh(action=action)
            assert (answer["status"], answer["stopped"]) == ("success", True)
            assert set(answer["robots"]) == {"arm-1", "arm-2", "both"}
            assert {name: facts["roster"]["size"] for name, facts in answer["networks"].items()} == {
                "device_connect": 2,
                "mesh": 2,
            }
        assert near.estops == far.estops == [("", EVERY_ROBOT, answer["estop_id"])]

    def test_stop_where_no_network_is_there_names_the_robots_of_each(
        self, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        assert robot_mesh(action="stop")["status"] == "success"
        near.unreachable, far.unreachable = "the cable is cut", "no hub"
        for action in ("stop", "emergency_stop"):
            answer = robot_mesh(action=action)
            assert (answer["status"], answer["stopped"]) == ("error", None)
            assert "It did not leave on device_connect: the cable is cut." in answer["reason"]
            assert "It did not leave on mesh: no hub." in answer["reason"]
        assert robot_mesh(action="stop", target="both")["stopped"] is None


class TestDefaultProfile:
    """``STRANDS_FLEET`` says which fleet the tool reaches, and its emergency stop with it."""

    @pytest.fixture
    def joined(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        """The networks that were joined or stopped, none of which answers."""
        found: list[str] = []

        def device_connect(self: DeviceConnectNetwork, *_: object, **__: object) -> None:
            link = self._link
            found.append(f"device connect {link.meet_port} {link.tenant}")
            raise UnreachableError("no answer")

        def mesh(*_: object, **__: object) -> None:
            found.append(f"mesh {settings.raw('STRANDS_MESH_PORT')} {settings.raw('STRANDS_MESH_NAMESPACE')}")
            raise UnreachableError("no answer")

        monkeypatch.setenv("STRANDS_MESH", "true")
        monkeypatch.setenv("STRANDS_MESH_PORT", "7001")
        monkeypatch.setenv("STRANDS_DC_PORT", "7002")
        for way in ("open", "emergency_stop"):
            monkeypatch.setattr(DeviceConnectNetwork, way, device_connect)
        monkeypatch.setattr(network, "_dialled", mesh)
        return found

    @pytest.fixture
    def write(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], None]:
        monkeypatch.setenv("STRANDS_FLEET", str(tmp_path / "lab.toml"))

        def written(content: str) -> None:
            (tmp_path / "lab.toml").write_text(content)
            (tmp_path / "lab.toml").chmod(0o644)

        return written

    @pytest.mark.parametrize("action", ["emergency_stop", "stop", "peers"])
    def test_both_networks_are_those_of_the_profile(
        self, joined: list[str], write: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, action: str
    ) -> None:
        write('port = 7101\ntenant = "lab"\n[mesh]\nport = 7102\nnamespace = "lab"')
        assert robot_mesh(action=action)["status"] == "error"
        assert sorted(joined) == ["device connect 7101 lab", "mesh 7102 lab"]
        joined.clear()
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
        assert robot_mesh(action=action)["status"] == "error"
        assert joined == ["mesh 7102 lab"]
        assert settings.raw("STRANDS_MESH_PORT") == "7001"

    def test_without_a_profile_they_are_those_of_the_environment(
        self, joined: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot_mesh(action="emergency_stop")
        assert sorted(joined) == ["device connect 7002 default", "mesh 7001 strands"]

    def test_fleet_on_the_mesh_alone_is_reached_there(self, joined: list[str], write: Callable[[str], None]) -> None:
        write("[mesh]\nport = 7102")
        robot_mesh(action="emergency_stop")
        assert joined == ["mesh 7102 strands"]

    def test_fleet_without_a_mesh_is_not_stopped_on_another_ones(
        self, joined: list[str], write: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write("port = 7101")
        assert robot_mesh(action="emergency_stop")["status"] == "error"
        assert joined == ["device connect 7101 default"]
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
        answer = robot_mesh(action="emergency_stop")
        assert (answer["status"], answer["stopped"]) == ("error", None)
        assert f"mesh: the connection profile {settings.raw('STRANDS_FLEET')} has none" in answer["reason"]
        assert joined == ["device connect 7101 default"]

    def test_table_that_cannot_be_used_refuses_no_stop_on_the_other_network(
        self, joined: list[str], write: Callable[[str], None]
    ) -> None:
        write('port = 7101\n[mesh]\nport = "?"')
        answer = robot_mesh(action="emergency_stop")
        assert (answer["status"], answer["stopped"]) == ("error", None)
        assert "mesh.port" in answer["reason"]
        assert joined == ["device connect 7101 default"]
        assert "mesh.port" in robot_mesh(action="status", target="arm-1")["reason"]
        joined.clear()
        write('[mesh]\nport = "?"')
        # Device Connect of this machine is another fleet's.
        assert "mesh.port" in robot_mesh(action="emergency_stop")["reason"]
        assert joined == []

    @pytest.mark.parametrize("value", ["auto", "off"])
    def test_profile_that_cannot_be_read_is_an_error_that_stops_no_other_fleet(
        self, joined: list[str], write: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, value: str
    ) -> None:
        write("tennant = 1")
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", value)
        answer = robot_mesh(action="emergency_stop")
        assert (answer["status"], answer["stopped"], joined) == ("error", None, [])
        assert "unknown key 'tennant'" in answer["reason"]
