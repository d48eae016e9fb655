"""A real ``strands.Agent`` with the real tool, a real network on loopback, and a toy world."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually, free_port
from strands import Agent

from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.testing import ScriptedModel
from strands_robots.tools import robot_mesh


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, patient_halts: None) -> Iterator[ToyWorld]:
    """One toy world, served on a loopback port that the tool uses too."""
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    toy = ToyWorld("toys", robots=("left",))
    runtime = init_device_connect_sync(toy, peer_id="toys", link=loopback_config())
    try:
        yield toy
    finally:
        toy.close()
        stop_device_connect(runtime)


def results(*calls: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the tool's answer to each call of an agent, one call a turn."""
    model = ScriptedModel([*(("robot_mesh", each) for each in calls), "That is all."])
    agent = Agent(model=model, tools=[robot_mesh], callback_handler=None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        agent("go")
    return [block["toolResult"] for message in agent.messages for block in message["content"] if "toolResult" in block]


def test_agent_finds_drives_and_stops_a_robot(world: ToyWorld) -> None:
    answers = results(
        {"action": "peers"},
        {"action": "tell", "target": "toys", "instruction": "wave", "duration": 300},
        {"action": "status", "target": "toys"},
        {"action": "stop", "target": "toys"},
    )
    assert [each["status"] for each in answers] == ["success"] * 4
    assert "toys" in str(answers[0]["content"])
    assert "wave" in str(answers[2]["content"])
    assert world.list_policies_running() == []
    assert world.writes


@pytest.mark.parametrize("where", ["among its inputs", "in its arguments"])
def test_agent_that_misspells_the_duration_moves_nothing_and_reads_which_word_it_meant(
    world: ToyWorld, where: str
) -> None:
    tell = {"action": "tell", "target": "toys", "instruction": "wave"}
    call = {"action": "call", "target": "toys", "verb": "execute", "arguments": {"instruction": "wave"}}
    if where == "among its inputs":
        misspelled = [{**tell, "durration": 1}, {**call, "durration": 1}]
    else:
        misspelled = [{**tell, "arguments": {"durration": 1}}]
        misspelled += [{**call, "arguments": {"instruction": "wave", "durration": 1}}]
    for answer in results(*misspelled):
        assert answer["status"] == "error"
        assert "durration (did you mean duration?)" in str(answer["content"])
    assert not world.writes


def test_agents_read_and_stop_with_an_input_that_the_tool_does_not_have(world: ToyWorld) -> None:
    answers = results({"action": "status", "target": "toys", "x": 1}, {"action": "stop", "target": "toys", "x": 1})
    assert [each["status"] for each in answers] == ["success"] * 2


def test_emergency_stop_halts_and_locks_every_robot_by_name(world: ToyWorld) -> None:
    wave = {"action": "tell", "target": "toys", "instruction": "wave", "duration": 300}
    answers = results(wave, {"action": "emergency_stop", "instruction": "smoke"}, wave)
    assert answers[1]["status"] == "success"
    assert "toys" in str(answers[1]["content"])
    eventually(lambda: not world.list_policies_running(), what="the toy world stands still")
    assert answers[2]["status"] == "error"
    assert "lock" in str(answers[2]["content"])


def test_robot_that_does_not_stop_is_an_error_by_name(world: ToyWorld) -> None:
    world.start_policy("left", "wave", duration=300)
    world.stubborn = True
    (answer,) = results({"action": "stop"})
    assert answer["status"] == "error"
    assert "DID NOT STOP: toys" in str(answer["content"])


def test_emergency_stop_that_fails_on_a_robot_is_an_error_by_name(world: ToyWorld) -> None:
    world.start_policy("left", "wave", duration=300)
    world.stubborn = True
    (answer,) = results({"action": "emergency_stop"})
    assert answer["status"] == "error"
    assert "toys did not stop" in str(answer["content"])


def test_silent_robot_is_an_error_by_name(world: ToyWorld) -> None:
    calls = [{"action": action, "target": "no-such-robot"} for action in ("stop", "status")]
    for answer in results(*calls):
        assert answer["status"] == "error"
        assert "no-such-robot" in str(answer["content"])
