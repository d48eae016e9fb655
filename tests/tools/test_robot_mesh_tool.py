from __future__ import annotations

import base64
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.barista import Barista
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually

from strands_robots import settings
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import Envelope, success
from strands_robots.errors import UnreachableError
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.mesh import network
from strands_robots.fleet.mesh.joining import joined_mesh
from strands_robots.mesh import Mesh, init_mesh, safety
from strands_robots.mesh.session import clear_peers
from strands_robots.mesh.transport import zenoh_config
from strands_robots.serving.advertised import AdvertisedVerb, find_verb
from strands_robots.tools import networks, robot_mesh
from strands_robots.tools.networks import Robots


class FakeNetwork:
    """Records its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __getattr__(self, verb: str) -> Callable[..., Envelope]:
        def called(*arguments: Any) -> Envelope:
            self.calls.append((verb, *arguments))
            return success("done")

        return called


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeNetwork:
    network = FakeNetwork()
    monkeypatch.setattr(networks, "network", lambda: network)
    return network


def test_every_action_reaches_the_network(fake: FakeNetwork) -> None:
    robot_mesh(action="peers")
    robot_mesh(action="tell", target="arm-1", instruction="wave", duration=2)
    robot_mesh(action="status", target="arm-1")
    robot_mesh(action="stop", target="arm-1")
    robot_mesh(action="stop")
    robot_mesh(action="stop", target="world-1", arguments={"robot_name": "left"})
    robot_mesh(action="emergency_stop", instruction="smoke")
    robot_mesh(action="release_torque", target="arm-1")
    assert fake.calls == [
        ("peers",),
        ("tell", "arm-1", "wave", "mock", 2.0),
        ("status", "arm-1"),
        ("stop", "arm-1"),
        ("stop", ""),
        ("stop", "world-1", "left"),
        ("emergency_stop", "smoke"),
        ("release_torque", "arm-1"),
    ]


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
        ({"action": "status"}, "target"),
        ({"action": "move", "arguments": {"x": 1}}, "target"),
        ({"action": "call", "target": "arm-1"}, "verb"),
        ({"action": "call", "target": "arm-1", "verb": "a/b"}, "verb"),
        ({"action": "move", "target": "arm-1", "arguments": [1]}, "arguments"),
        ({"action": "release_torque"}, "target"),
    ],
)
def test_argument_out_of_its_domain_is_refused_by_name(
    fake: FakeNetwork, arguments: dict[str, Any], named: str
) -> None:
    answer = robot_mesh(**arguments)
    assert answer["status"] == "error"
    assert named in answer["reason"]
    assert fake.calls == []


@pytest.mark.parametrize(
    ("given", "called"),
    [
        ({"action": "emergency_stop"}, ("emergency_stop", "")),
        ({"action": "emergency_stop", "instruction": "x" * 100_000}, ("emergency_stop", "x" * 200)),
        ({"action": "emergency_stop", "instruction": "a\nb", "duration": "?"}, ("emergency_stop", "a b")),
        ({"action": "emergency_stop", "instruction": 5, "target": "a b"}, ("emergency_stop", "5")),
        ({"action": "stop", "target": "arm 1"}, ("stop", "")),
        ({"action": "stop", "target": ["arm-1"], "reason": "x"}, ("stop", "")),
        ({"action": "stop", "arguments": {"robot_name": "left"}}, ("stop", "")),
        ({"action": "stop", "target": "world-1", "arguments": {"robot": "left"}}, ("stop", "world-1")),
        ({"action": "stop", "target": "world-1", "arguments": {"robot_name": ""}}, ("stop", "world-1")),
        ({"action": "stop", "target": "world-1", "arguments": {"robot_name": [1]}}, ("stop", "world-1")),
        ({"action": "stop", "target": "world-1", "arguments": "left"}, ("stop", "world-1")),
        ({"action": "stop", "target": "world-1", "arguments": {"robot_name": "left"}}, ("stop", "world-1", "left")),
    ],
)
async def test_no_argument_refuses_a_stop(fake: FakeNetwork, given: dict[str, Any], called: tuple[Any, ...]) -> None:
    use = {"toolUseId": "1", "name": "robot_mesh", "input": given}
    events = [event async for event in robot_mesh.stream(use, {})]
    assert fake.calls == [called], events


def test_verbs_are_called_with_their_arguments(fake: FakeNetwork) -> None:
    robot_mesh(action="move", target="arm-1", arguments={"x": 0.2, "y": 0.0, "z": 0.1})
    robot_mesh(action="move", target="arm-1", verb="pick", arguments={"object": "cube"})
    robot_mesh(action="call", target="base-1", verb="drive", arguments={"linear": 0.1})
    robot_mesh(action="wait", target="arm-1")
    assert [call[:4] for call in fake.calls] == [
        ("call", "arm-1", "moveTo", {"x": 0.2, "y": 0.0, "z": 0.1}),
        ("call", "arm-1", "pick", {"object": "cube"}),
        ("call", "base-1", "drive", {"linear": 0.1}),
        ("call", "arm-1", "wait", {}),
    ]


def test_picture_is_an_image_block(fake: FakeNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = success("front, 2 x 2 pixels.", camera="front") | {"jpeg": base64.b64encode(b"\xff\xd8x").decode()}
    monkeypatch.setattr(networks, "network", lambda: SimpleNamespace(call=lambda *_: answer))
    shown = robot_mesh(action="picture", target="arm-1", arguments={"camera": "front"})
    assert shown["content"][-1] == {"image": {"format": "jpeg", "source": {"bytes": b"\xff\xd8x"}}}
    assert "jpeg" not in shown
    answer["jpeg"] = "no base64!"
    assert "could not be decoded" in robot_mesh(action="picture", target="arm-1")["reason"]


def test_picture_of_a_motion_is_an_image_block_of_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = {"camera": "table", "format": "jpeg", "jpeg": base64.b64encode(b"\xff\xd8x").decode()}
    answer = success("moveTo completed.", error_mm=0.4) | {"picture": taken}
    monkeypatch.setattr(networks, "network", lambda: SimpleNamespace(call=lambda *_: answer))
    shown = robot_mesh(action="move", target="arm-1", arguments={"x": 0.2, "y": 0.0, "z": 0.1, "picture": "table"})
    assert shown["content"][-1] == {"image": {"format": "jpeg", "source": {"bytes": b"\xff\xd8x"}}}
    assert shown["error_mm"] == 0.4
    assert "picture" not in shown


@pytest.mark.parametrize("value", ["off", "OFF", "0", "false"])
def test_native_mesh_is_used_when_device_connect_is_off(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", value)
    assert networks.network().joined is networks.on_mesh


@pytest.fixture
def on_the_mesh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    monkeypatch.setattr(zenoh_config, "DISCOVERY_S", 0.1)
    monkeypatch.setattr(networks, "STOP_S", 20.0)
    monkeypatch.setattr(safety, "COLLECT_S", 20.0)
    clear_peers()
    yield
    clear_peers()


def test_every_action_on_an_empty_mesh_is_an_error(on_the_mesh: None) -> None:
    for arguments in ({"action": "peers"}, {"action": "stop"}, {"action": "emergency_stop"}):
        assert robot_mesh(**arguments)["status"] == "error"


def test_disabled_mesh_is_reported_as_off(on_the_mesh: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH", "false")
    answer = robot_mesh(action="stop")
    assert "native mesh is off" in answer["reason"]
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
    with joined_mesh(robot, "bar-1", "robot"), joined_mesh(None, "looker", "tool") as looker:
        # All peers of one process share their list of peers.
        eventually(lambda: looker.get_peer("bar-1") is not None)
        yield robot


def test_own_verb_of_a_mesh_peer_is_waited_for_as_long_as_it_lasts(barista: Barista) -> None:
    answer = networks.network().call("bar-1", "brewCoffee", {"cups": 2}, seconds=1e-6)
    assert answer["cups"] == 2


def test_silent_peer_of_the_mesh_is_named(barista: Barista, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Mesh, "send", lambda *_: {"status": "timeout"})
    assert robot_mesh(action="status", target="bar-1")["reason"] == "bar-1 did not answer."


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


@pytest.mark.parametrize("value", ["auto", "on", "", "maybe"])
def test_device_connect_is_the_default_network(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", value)
    assert networks.network().joined is networks.on_device_connect


def test_remote_network_needs_an_opt_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NATS_URL", "nats://192.0.2.1:4222")
    answer = robot_mesh(action="stop", target="arm-1")
    assert answer["status"] == "error"
    assert "allow_insecure" in answer["reason"]
    assert answer["stopped"] is None


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


class FakeFleet:
    """A connection to one robot with a verb of its own, and to a device that is none of ours."""

    stale = ""

    def __init__(self) -> None:
        self.called: list[tuple[Any, ...]] = []

    def peers(self, timeout: float) -> list[Peer]:
        resume = {"name": "resume", "parameters": {"properties": {"assertion": {"type": "object"}}}}
        ours = (resume, *({"name": f"{name}Control"} for name in ("acquire", "renew", "release")), {"name": "stop"})
        return [Peer("bar-1", functions=(BREW, *ours)), Peer("echo-1", functions=({"name": "echo"},))]

    def verb(self, device: str, name: str) -> AdvertisedVerb | None:
        return find_verb([BREW], name)

    def call(self, *called: Any) -> Envelope:
        self.called.append(called)
        return success("done")


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> FakeFleet:
    fake = FakeFleet()
    joined = DeviceConnectNetwork.joined(fake)  # type: ignore[arg-type]
    monkeypatch.setattr(networks, "network", lambda: Robots(lambda: nullcontext(joined)))
    return fake


def test_own_verb_is_called_with_its_arguments_for_as_long_as_it_lasts(fleet: FakeFleet) -> None:
    robot_mesh(action="call", target="bar-1", verb="brewCoffee", arguments={"cups": 2})
    robot_mesh(action="call", target="bar-1", verb="ownUnknown")
    assert fleet.called == [("bar-1", "brewCoffee", {"cups": 2}, 125.0), ("bar-1", "ownUnknown", {}, 35.0)]


def test_peers_name_own_verbs_with_their_parameters_and_devices_that_cannot_be_stopped(fleet: FakeFleet) -> None:
    bar, echo = robot_mesh(action="peers")["peers"]
    assert bar["functions"][:3] == ["brewCoffee", "resume", "acquireControl"]
    assert bar["own_verbs"] == {"brewCoffee": "(cups: integer, 1 to 8) Brew coffee."}
    assert "note" not in bar
    assert echo["note"] == "This device has no lockout, no lease and no stop."


class TestDefaultProfile:
    """``STRANDS_FLEET`` says which fleet the tool reaches, and its emergency stop with it."""

    @pytest.fixture
    def joined(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        """The networks that were joined, none of which answers."""
        found: list[str] = []

        def device_connect(_self: object, link: LinkConfig, _source: str) -> None:
            found.append(f"device connect {link.meet_port} {link.tenant}")
            raise UnreachableError("no answer")

        def mesh(*_: object) -> None:
            found.append(f"mesh {settings.raw('STRANDS_MESH_PORT')} {settings.raw('STRANDS_MESH_NAMESPACE')}")
            raise UnreachableError("no answer")

        monkeypatch.setenv("STRANDS_MESH_PORT", "7001")
        monkeypatch.setenv("STRANDS_DC_PORT", "7002")
        monkeypatch.setattr(DeviceConnectNetwork, "__init__", device_connect)
        monkeypatch.setattr("strands_robots.fleet.mesh.joining.joined_mesh", mesh)
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
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
        assert robot_mesh(action=action)["status"] == "error"
        assert joined == ["device connect 7101 lab", "mesh 7102 lab"]
        assert settings.raw("STRANDS_MESH_PORT") == "7001"

    def test_without_a_profile_they_are_those_of_the_environment(
        self, joined: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot_mesh(action="emergency_stop")
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
        robot_mesh(action="emergency_stop")
        assert joined == ["device connect 7002 default", "mesh 7001 strands"]

    def test_fleet_on_the_mesh_alone_is_reached_there(self, joined: list[str], write: Callable[[str], None]) -> None:
        write("[mesh]\nport = 7102")
        robot_mesh(action="emergency_stop")
        assert joined == ["mesh 7102 strands"]

    def test_fleet_without_a_mesh_is_not_stopped_on_another_ones(
        self, joined: list[str], write: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write("port = 7101")
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
        answer = robot_mesh(action="emergency_stop")
        assert (answer["status"], "has no mesh" in answer["reason"], joined) == ("error", True, [])

    @pytest.mark.parametrize("value", ["auto", "off"])
    def test_profile_that_cannot_be_read_is_an_error_that_stops_no_other_fleet(
        self, joined: list[str], write: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, value: str
    ) -> None:
        write("tennant = 1")
        monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", value)
        answer = robot_mesh(action="emergency_stop")
        assert (answer["status"], answer["stopped"], joined) == ("error", None, [])
        assert "unknown key 'tennant'" in answer["reason"]
