"""``call --mesh``, with a robot of this process on a mesh in memory."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.barista import Barista
from fixtures.waiting import eventually
from tests.cli.conftest import Run

from strands_robots.cli import peers
from strands_robots.cli.network import mesh_peer
from strands_robots.fleet.adapter import FoundRobot
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.mesh import Mesh
from strands_robots.mesh.session import clear_peers
from strands_robots.mesh.transport import config


@pytest.fixture
def barista(monkeypatch: pytest.MonkeyPatch) -> Iterator[Barista]:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    monkeypatch.setattr(config, "DISCOVERY_S", 0.1)
    clear_peers()
    robot = Barista()
    with mesh_peer(robot, "bar-1", "robot"), mesh_peer(None, "looker", "tool") as looker:
        # All peers of one process share their list of peers.
        eventually(lambda: looker.get_peer("bar-1") is not None)
        yield robot
    clear_peers()


def test_own_verb_is_called_with_its_types_for_as_long_as_it_lasts(
    run: Run, barista: Barista, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "CALL_S", 1e-6)
    result = run("call", "--mesh", "bar-1", "brewCoffee", "cups=2", "strength=strong", "--json")
    answer = json.loads(result.stdout)
    assert "cups" in answer, answer
    assert (result.exit_code, answer["cups"], answer["strength"]) == (0, 2, "strong")


@pytest.mark.parametrize("argument", ["cups=nine", "cups=9", "sugar=1"])
def test_argument_that_does_not_fit_an_own_verb_is_exit_2(run: Run, barista: Barista, argument: str) -> None:
    result = run("call", "--mesh", "bar-1", "brewCoffee", argument)
    assert result.exit_code == 2, result.output
    assert barista.writes == 0


def test_peers_of_the_mesh_are_listed_and_what_one_can_do(run: Run, barista: Barista) -> None:
    listed = json.loads(run("peers", "--mesh", "--timeout", "0.1", "--json").stdout)["peers"]
    (bar,) = (row for row in listed if row["peer_id"] == "bar-1")
    assert (bar["type"], bar["reachable"], bar["locked"]) == ("robot", True, False)
    assert "bar-1" in run("peers", "--mesh", "--timeout", "0.1").stdout
    assert "brewCoffee (its own)" in run("peers", "bar-1", "--mesh", "--timeout", "0.1").stdout


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"estop_unheard": True, "locked": True}, "CANNOT RECEIVE STOPS"),
        ({"distrusted": "its key is another one", "locked": True}, "its key is another one"),
        ({"locked": True}, "LOCKED"),
        ({}, "idle"),
    ],
)
def test_state_of_a_peer_that_matters_most_is_shown(
    run: Run, barista: Barista, monkeypatch: pytest.MonkeyPatch, facts: dict[str, Any], said: str
) -> None:
    found = FoundRobot("arm-1", "robot", status="idle", age_s=0.1, facts=facts)
    monkeypatch.setattr(MeshNetwork, "find", lambda *_, **__: [found])
    assert said in run("peers", "--mesh").stdout


def test_mesh_without_peers_is_exit_3(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    clear_peers()
    result = run("peers", "--mesh", "--timeout", "0.1")
    assert (result.exit_code, result.stderr) == (3, "No peer is on the mesh of this machine.\n")


@pytest.mark.parametrize("command", [("stop", "arm-1"), ("stop", "--all"), ("estop",)])
def test_stop_on_a_mesh_that_is_off_is_exit_3(
    run: Run, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.setenv("STRANDS_MESH", "false")
    result = run(*command, "--mesh", "--json")
    said = json.loads(result.stdout)
    assert (result.exit_code, said["stopped"]) == (3, None)
    assert "native mesh is off" in said["reason"]


@pytest.mark.parametrize(("device", "said"), [("bar-1", "bar-1 did not answer."), ("bar-2", "Near it: bar-1.")])
def test_no_answer_is_exit_3(
    run: Run, barista: Barista, monkeypatch: pytest.MonkeyPatch, device: str, said: str
) -> None:
    monkeypatch.setattr(Mesh, "send", lambda *_: {"status": "timeout"})
    result = run("call", "--mesh", device, "status")
    assert result.exit_code == 3
    assert said in result.stderr


@pytest.mark.parametrize(("function", "told"), [("brewCoffee", True), ("beansLeft", False), ("status", False)])
def test_ctrl_c_of_a_motion_names_the_stop_on_the_mesh(
    run: Run, barista: Barista, monkeypatch: pytest.MonkeyPatch, function: str, told: bool
) -> None:
    send = Mesh.send

    def interrupted(mesh: Mesh, target: str, command: dict[str, Any], timeout: float = 1.0) -> dict[str, Any]:
        if command["action"] == function:
            raise KeyboardInterrupt
        return send(mesh, target, command, timeout)

    monkeypatch.setattr(Mesh, "send", interrupted)
    result = run("call", "--mesh", "bar-1", function, *(["cups=1"] if told else []))
    assert result.exit_code == 130
    assert ("The robot may still move. Stop it: strands-robots stop bar-1 --mesh" in result.stderr) is told
