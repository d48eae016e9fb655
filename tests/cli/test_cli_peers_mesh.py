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
from strands_robots.fleet.mesh.joining import joined_mesh
from strands_robots.mesh import Mesh
from strands_robots.mesh.session import clear_peers
from strands_robots.mesh.transport import zenoh_config


@pytest.fixture
def barista(monkeypatch: pytest.MonkeyPatch) -> Iterator[Barista]:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    monkeypatch.setattr(zenoh_config, "DISCOVERY_S", 0.1)
    clear_peers()
    robot = Barista()
    with joined_mesh(robot, "bar-1", "robot"), joined_mesh(None, "looker", "tool") as looker:
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


@pytest.mark.parametrize(("device", "said"), [("bar-1", "bar-1 did not answer."), ("bar-2", "Near it: bar-1.")])
def test_no_answer_is_exit_3(run: Run, barista: Barista, device: str, said: str) -> None:
    result = run("call", "--mesh", device, "status", "--timeout", "0.000001")
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
