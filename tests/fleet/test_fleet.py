"""Fleet: both networks at once, an id on both, absent networks, the stop of all."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.fleet.scripted import OURS, ScriptedNetwork

from strands_robots import errors
from strands_robots.envelope import error, success
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.device_connect.config import LinkFlags
from strands_robots.fleet.fleet import Fleet, connect
from strands_robots.safety.identity import ROBOTS, KeyFile, SigningIdentity
from strands_robots.safety.statements import Purpose, signed
from strands_robots.utils import ValidationError


@pytest.fixture
def device_connect() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"arm-1": OURS, "both": OURS})


@pytest.fixture
def mesh() -> ScriptedNetwork:
    return ScriptedNetwork(MESH, {"arm-2": OURS, "both": OURS})


@pytest.fixture
def fleet(device_connect: ScriptedNetwork, mesh: ScriptedNetwork) -> Any:
    with Fleet([device_connect, mesh]) as joined:
        yield joined


def test_robots_of_both_networks_are_found(fleet: Fleet) -> None:
    found = [(robot.id, robot.network) for robot in fleet.robots()]
    assert found == [("arm-1", DEVICE_CONNECT), ("arm-2", MESH), ("both", DEVICE_CONNECT)]
    assert [robot.id for robot in fleet.where(network=MESH)] == ["arm-2"]
    assert [robot.id for robot in fleet.where(kind="gantry")] == []
    assert "arm-2" in fleet
    assert "arm-9" not in fleet
    assert fleet["arm-1"] is fleet["arm-1"]


def test_absent_robot_is_refused_with_similar_names(fleet: Fleet) -> None:
    with pytest.raises(errors.NoSuchRobotError, match="Near it: arm-"):
        fleet["arm-9"]


def test_motion_of_an_id_on_both_is_refused_naming_both(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork
) -> None:
    both = fleet["both"]
    with pytest.raises(errors.AmbiguousRobotError, match="device_connect and mesh"):
        both.move_to(x=1)
    with pytest.raises(errors.AmbiguousRobotError), both.control():
        pytest.fail("controlled")
    assert both.status()["status"] == "success"
    moved = [call for call in (*device_connect.calls, *mesh.calls) if call[1] != "getStatus"]
    assert not moved


@pytest.fixture
def keys(tmp_path: Path) -> list[SigningIdentity]:
    return [KeyFile(ROBOTS, name, tmp_path).load_or_make() for name in ("one", "two")]


def test_id_on_both_is_one_robot_where_one_key_signs_both(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork, keys: list[SigningIdentity]
) -> None:
    device_connect.sign_with(keys[0])
    mesh.sign_with(keys[0])
    both = fleet["both"]
    both.move_to(x=1)
    both.move_to(x=2)
    assert [call[1] for call in device_connect.calls] == ["getStatus", "moveTo", "moveTo"]
    assert [call[1] for call in mesh.calls] == ["getStatus"]
    mesh.sign_with(keys[1])
    mesh.sessions += 1
    with pytest.raises(errors.AmbiguousRobotError, match=r"another id.*connect\(mesh=False\)"):
        both.move_to(x=3)


def test_robot_of_one_key_is_moved_on_the_network_on_which_it_still_answers(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork, keys: list[SigningIdentity]
) -> None:
    device_connect.sign_with(keys[0])
    mesh.sign_with(keys[0])
    both = fleet["both"]
    both.move_to(x=1)
    device_connect.answers["getStatus"] = errors.NoAnswerError("it did not answer")
    device_connect.sessions += 1
    both.move_to(x=2)
    assert [call[1] for call in mesh.calls if call[1] == "moveTo"] == ["moveTo"]
    mesh.sign_with(keys[1])
    mesh.sessions += 1
    with pytest.raises(errors.AmbiguousRobotError):
        both.move_to(x=3)


def test_enrolled_robot_wins_an_id_on_both(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork, keys: list[SigningIdentity]
) -> None:
    device_connect.sign_with(keys[0])
    mesh.sign_with(keys[1])
    device_connect.enrolled = mesh.enrolled = {"both": keys[1].public}
    both = fleet["both"]
    both.move_to(x=1)
    assert both.network == MESH
    assert [call[1] for call in device_connect.calls] == ["getStatus"]
    assert [call[1] for call in mesh.calls] == ["getStatus", "moveTo"]
    fleet.robots()
    assert both.network == MESH


def test_recorded_signature_proves_nothing(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork, keys: list[SigningIdentity]
) -> None:
    device_connect.sign_with(keys[0])
    old = signed(keys[0], Purpose.LOCKOUT_STATE, "both", {"nonce": "0" * 32})
    mesh.answers["getStatus"] = lambda arguments: success("idle", statement=old)
    with pytest.raises(errors.AmbiguousRobotError):
        fleet["both"].move_to(x=1)


def test_halt_of_an_id_on_both_reaches_both(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork
) -> None:
    assert fleet["both"].halt().stopped is True
    assert (device_connect.stopped, mesh.stopped) == (["both"], ["both"])
    mesh.stops = error("no brakes", stopped=False)
    verdict = fleet["both"].halt()
    assert verdict.stopped is False
    assert list(verdict.not_stopped) == ["both on mesh"]
    device_connect.stops = mesh.stops = success("Stopped turnPlate.", stopped=True, halted=["turnPlate"])
    assert fleet["both"].halt().halted == ("turnPlate",)


def test_robot_that_comes_up_on_the_other_network_makes_its_motions_ambiguous(
    fleet: Fleet, mesh: ScriptedNetwork
) -> None:
    arm = fleet["arm-1"]
    assert arm.move_to(x=1)
    mesh.robots["arm-1"] = OURS
    with pytest.raises(errors.AmbiguousRobotError):
        arm.move_to(x=1)


def test_network_that_cannot_be_reached_is_absent_with_its_reason(
    device_connect: ScriptedNetwork, mesh: ScriptedNetwork
) -> None:
    mesh.unreachable = "no mesh answers"
    with Fleet([device_connect, mesh]) as fleet:
        assert fleet.absent == {MESH: "no mesh answers"}
        assert [robot.id for robot in fleet.robots()] == ["arm-1", "both"]
        with pytest.raises(errors.NoSuchRobotError, match="Not joined: mesh, no mesh answers"):
            fleet["arm-2"]
    device_connect.unreachable = "no broker"
    with (
        pytest.raises(errors.UnreachableError, match=r"no broker; mesh: no mesh answers"),
        Fleet([device_connect, mesh]),
    ):
        pytest.fail("joined")


def test_stop_of_all_gives_verdicts_by_id(fleet: Fleet, mesh: ScriptedNetwork) -> None:
    mesh.stops = error("no brakes", stopped=False)
    verdicts = fleet.stop()
    assert {name: verdict.stopped for name, verdict in verdicts.items()} == {
        "arm-1": True,
        "arm-2": False,
        "both": False,
    }


def test_stop_of_all_names_a_network_that_fails(fleet: Fleet, mesh: ScriptedNetwork) -> None:
    mesh.stops = OSError("cable")
    verdicts = fleet.stop()
    assert verdicts["arm-1"].stopped
    assert not verdicts["the robots on mesh"].stopped


class Lost(Exception):
    """Raised by a network's own library."""


def test_network_that_fails_is_absent_and_the_others_go_on(
    fleet: Fleet, device_connect: ScriptedNetwork, mesh: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_arguments: object, **_options: object) -> Any:
        raise Lost("cable")

    with monkeypatch.context() as patch:
        patch.setattr(device_connect, "find", lost)
        patch.setattr(device_connect, "stop_all", lost)
        assert [robot.id for robot in fleet.robots()] == ["arm-2", "both"]
        assert fleet.absent == {DEVICE_CONNECT: "Lost: cable"}
        verdicts = fleet.stop()
        assert verdicts["arm-2"].stopped
        assert not verdicts["the robots on device_connect"].stopped
        patch.setattr(mesh, "find", lost)
        with pytest.raises(errors.UnreachableError, match="mesh: Lost: cable"):
            fleet.robots()
    assert len(fleet.robots()) == 3
    assert fleet.absent == {}


def test_other_network_is_left_where_one_fails(
    device_connect: ScriptedNetwork,
    mesh: ScriptedNetwork,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def lost() -> None:
        raise Lost("bad certificate")

    with monkeypatch.context() as patch:
        patch.setattr(device_connect, "open", lost)
        with pytest.raises(Lost), Fleet([device_connect]):
            pytest.fail("joined")
        with Fleet([device_connect, mesh]) as fleet:
            assert [each.id for each in fleet.robots()] == ["arm-2", "both"]
            assert fleet.absent == {DEVICE_CONNECT: "Lost: bad certificate"}
    assert "device_connect cannot be joined" in caplog.text
    assert not mesh.joined
    with Fleet([device_connect, mesh]):
        monkeypatch.setattr(device_connect, "close", lost)
    assert not mesh.joined


@pytest.mark.parametrize(
    "use", [Fleet.robots, Fleet.where, Fleet.stop, list, lambda fleet: fleet["arm-1"], lambda fleet: "arm-9" in fleet]
)
def test_fleet_that_is_not_joined_says_so(use: Any, device_connect: ScriptedNetwork) -> None:
    fleet = Fleet([device_connect])
    for _ in range(2):
        with pytest.raises(errors.UnreachableError, match="not joined: use it as a context manager"):
            use(fleet)
        with fleet:
            assert fleet["arm-1"]


def test_id_that_is_no_text_is_refused(fleet: Fleet) -> None:
    with pytest.raises(ValidationError, match="not 5"):
        fleet[5]  # type: ignore[index]
    assert 5 not in fleet


ENDING = """
import atexit
from tests.fleet.scripted import ScriptedNetwork
from strands_robots.fleet import Fleet
fleet = Fleet([ScriptedNetwork("device_connect"), ScriptedNetwork("mesh")]).__enter__()
arm = fleet["arm-1"]
atexit.register(lambda: print(arm.halt().stopped, fleet.stop()["arm-1"].stopped))
"""


def test_robots_are_stopped_while_the_interpreter_ends() -> None:
    ended = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True, check=False)
    assert (ended.stdout, ended.stderr) == ("True True\n", "")


def test_networks_are_left_at_the_end(device_connect: ScriptedNetwork, mesh: ScriptedNetwork) -> None:
    with Fleet([device_connect, mesh]):
        assert device_connect.joined
        assert mesh.joined
    assert not device_connect.joined
    assert not mesh.joined


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"connect": ["tcp/192.0.2.1:7447"]}, "needs authentication: certificates \\(tls_ca, tls_cert, tls_key\\)"),
        ({"nats": ["nats://127.0.0.1:4222"], "multicast": True}, "nats names a broker"),
        ({"nats": "nats://192.0.2.1:4222"}, "needs authentication"),
        ({"tls_ca": "/absent"}, "tls_ca /absent is no file"),
        ({"name": "a.b"}, "name must be"),
    ],
)
def test_connect_refuses_arguments_by_name(arguments: Any, named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        connect(**arguments)


def test_connect_takes_credentials_and_sets_no_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MESSAGING_CREDENTIALS_FILE", raising=False)
    file = tmp_path / "arm.creds.json"
    secrets = {"urls": ["nats://127.0.0.1:4222"], "jwt": "j", "nkey_seed": "s"}
    file.write_text(json.dumps({"tenant": "lab", "nats": secrets}))
    for flags in (LinkFlags(credentials=file), LinkFlags(nats=["nats://127.0.0.1:4222"], credentials=file)):
        link = flags.link()
        assert (link.transport, link.tenant, link.jwt) == ("nats", "lab", "j")
    assert "MESSAGING_CREDENTIALS_FILE" not in os.environ


def test_connect_without_arguments_is_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH", "false")
    assert connect().absent == {MESH: "it is switched off"}
    assert connect(mesh=False).absent == {MESH: "it is switched off"}
