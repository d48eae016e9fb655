"""A robot that is led from elsewhere: what it keeps of the leads that are over."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots import lead_mixin
from strands_robots.envelope import is_error, text_of
from strands_robots.hardware import HardwareRobot
from strands_robots.policies.handover import LedPolicy
from strands_robots.policies.rollout import MOTIONS_HELD


@pytest.fixture
def arm() -> Iterator[Any]:
    robot: Any = HardwareRobot(RecordingDevice(), "arm-1")
    robot.connect()
    yield robot
    robot.cleanup()


def led_once(arm: Any, name: str) -> str:
    """Lead it, and end that; return the id of the lead."""
    opened = arm.lead(name)
    assert not is_error(opened), opened
    arm.lead_to(opened["lead_id"], 1, end=True)
    eventually(lambda: name not in arm.tasks.leading(), every=0.002)
    return str(opened["lead_id"])


def test_leads_that_are_over_do_not_add_up(arm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lead_mixin, "SESSIONS_MAX", 3)
    ids = [led_once(arm, f"hand-{number}") for number in range(12)]
    assert len(arm.tasks.by_leader) <= 4
    assert len(arm.teleop_status()["leaders"]) <= 4
    assert "is none" in text_of(arm.lead_to(ids[0], 2))


def test_hold_does_not_move_a_joint_that_stands_beyond_its_range(arm: Any) -> None:
    device = arm.device
    device.positions["pan.pos"] = 130.0
    opened = arm.lead("hand")
    for seq in range(1, 6):
        arm.lead_to(opened["lead_id"], seq, targets={"lift.pos": 10.0}, made=time.monotonic(), told=opened["now"])
        eventually(lambda: arm.lead_to(opened["lead_id"], 0)["written"], every=0.002)
    held = eventually(lambda: (now := arm.lead_to(opened["lead_id"], 0))["state"] == "held" and now, every=0.002)
    assert "no fresh command" in held["why"]
    assert {write.action["pan.pos"] for write in device.writes} == {130.0}
    assert arm.tasks.by_leader["hand"].counts["out_of_range_steps"] == 0


def test_led_robot_whose_motions_were_held_goes_on_by_a_new_turn_alone(arm: Any) -> None:
    opened, numbers = arm.lead("hand", spare_s=60.0), itertools.count(1)

    def sends(turn: int) -> Any:
        moment = time.monotonic()
        targets = {"pan.pos": 90.0}
        return arm.lead_to(opened["lead_id"], next(numbers), turn=turn, targets=targets, made=moment, told=moment)

    eventually(lambda: sends(1)["state"] == "led" and arm.device.writes, every=0.01)
    arm.gate.hold(0.05)
    held = eventually(lambda: (now := sends(1))["state"] == "held" and now, every=0.01)
    assert held["why"] == MOTIONS_HELD
    stood = eventually(lambda: not arm.gate.held and arm.device.positions["pan.pos"], every=0.01)
    steps = arm.tasks.by_leader["hand"].step_count
    eventually(lambda: sends(1) and arm.tasks.by_leader["hand"].step_count > steps + 5, every=0.01)
    assert arm.device.positions["pan.pos"] == pytest.approx(stood)
    eventually(lambda: sends(2)["state"] == "led" and arm.device.positions["pan.pos"] > stood + 5, every=0.01)


def test_command_of_a_lead_that_is_over_is_refused(arm: Any) -> None:
    answer = arm.lead_to(led_once(arm, "hand"), 2, targets={"pan.pos": 90.0})
    assert is_error(answer)
    assert answer["state"] == "over"


def test_command_that_was_read_before_a_hold_is_not_carried_out_after_it(
    arm: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    act, held_at = LedPolicy.act, list[float]()

    def acts(policy: LedPolicy, observation: Any) -> Any:
        action = act(policy, observation)
        if policy.lead.state == "led" and not held_at:
            held_at.append(arm.device.positions["pan.pos"])
            arm.gate.hold(0.05)
        return action

    monkeypatch.setattr(LedPolicy, "act", acts)
    opened = arm.lead("hand", spare_s=60.0)
    moment = time.monotonic()
    arm.lead_to(opened["lead_id"], 1, turn=1, targets={"pan.pos": 90.0}, made=moment, told=moment)
    eventually(lambda: held_at)
    steps = arm.tasks.by_leader["hand"].step_count
    eventually(lambda: arm.tasks.by_leader["hand"].step_count > steps + 3, every=0.01)
    assert arm.device.positions["pan.pos"] == pytest.approx(held_at[0])
