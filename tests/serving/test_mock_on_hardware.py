"""The policy ``mock`` follows no instruction: real hardware refuses it, and every other answer says so."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.toy_robots import ToyRobot

from strands_robots.contract import RolloutEvent
from strands_robots.envelope import RefusalReason
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.authorization import Approval
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.robot_verbs import TASK_VERBS
from strands_robots.simulation import Simulation


@pytest.fixture
def arm() -> Iterator[HardwareRobot]:
    made = HardwareRobot(RecordingDevice(), "arm", control_hz=200)
    made.connect()
    yield made
    made.cleanup()


def served(robot: Any, verb: Any = TASK_VERBS["execute"], *, hardware: bool = True, **arguments: Any) -> Result:
    approval = Approval(lambda _: ("execute", "start"), lambda: False)
    line = Pipeline.of(
        robot, lambda: "arm-1", hardware=hardware, authorize=lambda command, checked: None, approval=approval
    )
    results: list[Result] = []
    line.serve(Command(verb, {"instruction": "wave", **arguments}, "agent", line.pending.arrive()), results.append)
    return results[0]


@pytest.mark.parametrize(
    ("verb", "arguments"),
    [
        (TASK_VERBS["execute"], {}),
        (TASK_VERBS["execute"], {"policy_provider": "mock"}),
        (PEER_VERBS["start"], {"policy_provider": "mock"}),
    ],
    ids=["by default", "by name", "on the mesh"],
)
def test_real_hardware_refuses_mock_although_the_verb_is_approved(
    arm: HardwareRobot, monkeypatch: pytest.MonkeyPatch, verb: Any, arguments: dict[str, Any]
) -> None:
    monkeypatch.delenv("STRANDS_ALLOW_MOCK")
    result = served(arm, verb, **arguments)
    assert result.refusal is not None
    assert result.refusal.why is RefusalReason.APPROVAL
    for words in ("follows no instruction", "policy_provider", "--allow-mock"):
        assert words in result.result["reason"]
    assert arm.device.writes == []


def test_allowed_and_approved_it_moves_and_says_what_it_does(arm: HardwareRobot) -> None:
    events: list[RolloutEvent] = []
    arm.subscribe(events.append)
    answer = served(arm).result
    assert (answer["status"], answer["follows_instruction"]) == ("success", False)
    assert "does not follow the instruction" in answer["content"][0]["text"]
    arm.halt("test")
    assert events[0].follows_instruction is False


def test_a_simulation_moves_by_it_and_says_so() -> None:
    world = Simulation()
    world.add_robot("so100")
    answer = world.start_policy("so100", "wave")
    assert (answer["status"], answer["follows_instruction"]) == ("success", False)
    assert "does not follow the instruction" in answer["content"][0]["text"]
    world.cleanup()


def test_a_foreign_robot_decides_itself_what_its_default_policy_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STRANDS_ALLOW_MOCK")
    toy = ToyRobot()
    assert served(toy).result["status"] == "success"
    toy.close()


def test_the_schema_says_so_as_well() -> None:
    assert "follows no instruction" in TASK_VERBS["execute"].by_name["policy_provider"].meaning
