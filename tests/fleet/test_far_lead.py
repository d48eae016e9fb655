"""A leader's side of a lead: the newest command goes, and nothing waits for an answer."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.errors import LockoutError, NoAnswerError, RefusalError
from strands_robots.fleet.far_lead import LOST_S, SENDERS_MAX, FarLead

OPENED = {"lead_id": "s", "leader": "hand", "ranges": {"pan": [-1, 1], "wheel.vel": [None, None]}, "now": 5.0}


class Robot:
    """Answers commands, or fails as it is told."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []
        self.gate = threading.Event()
        self.gate.set()
        self.failure: RefusalError | None = None
        self.at = 0.0

    def __call__(self, verb: str, arguments: Mapping[str, Any], timeout: float) -> dict[str, Any]:
        assert verb == "leadTo"
        self.commands.append(dict(arguments))
        assert self.gate.wait(30)
        if self.failure is not None:
            raise self.failure
        written = arguments.get("targets", {})
        return {"status": "success", "now": 5.0 + arguments["seq"], "state": "led", "turn": 1, "written": written}

    def lead(self, *, policy: bool = False) -> FarLead:
        return FarLead("arm-1", self, OPENED, policy=policy, now=lambda: self.at)


def test_command_brings_what_the_robot_needs_to_judge_it() -> None:
    robot = Robot()
    with robot.lead() as lead:
        robot.at = 0.5
        lead.send({"pan": 0.1})
        eventually(lambda: lead.state.written == {"pan": 0.1})
    command, end = robot.commands
    assert command["told"] == 5.0
    assert (command["turn"], command["leads"], command["told_ago"], command["made"]) == (1, True, 0.5, 0.5)
    assert "picture_age_ms" not in command
    assert end["end"] is True
    assert lead.ranges == {"pan": (-1.0, 1.0), "wheel.vel": (float("-inf"), float("inf"))}


def test_commands_do_not_wait_for_a_robot_that_does_not_answer_and_the_newest_goes() -> None:
    robot = Robot()
    robot.gate.clear()
    with robot.lead() as lead:
        for number in range(40):
            lead.send({"pan": number / 100})
            eventually(lambda sent=number + 1: len(robot.commands) in (sent, SENDERS_MAX))
        robot.gate.set()
        eventually(lambda: lead.state.written == {"pan": 0.39})
        assert len(robot.commands) < 40, "those between were never sent"


def test_turns_are_numbered_and_a_policy_has_the_first() -> None:
    robot = Robot()
    with robot.lead(policy=True) as lead:
        for number, change in enumerate((lambda: None, lead.grip, lead.give_back, lead.grip)):
            robot.at += 1.0
            change()
            lead.send({"pan": 0.0})
            eventually(lambda most=number + 1: len(robot.commands) == most)
    turns = [(each["turn"], each["leads"]) for each in robot.commands[:4]]
    assert turns == [(0, False), (2, True), (3, False), (4, True)], "the robot has told of turn 1"


def test_lead_that_is_over_refuses_the_next_command_by_its_reason() -> None:
    robot = Robot()
    robot.failure = LockoutError("it is locked by an emergency stop", robot="arm-1", verb="leadTo")
    with robot.lead() as lead:
        lead.send({"pan": 0.0})
        eventually(lambda: lead.state.state == "over")
        with pytest.raises(LockoutError, match="locked by an emergency stop"):
            lead.send({"pan": 0.0})
    assert len(robot.commands) == 1, "nothing is sent to a robot that has ended it"


def test_command_without_an_answer_is_counted_and_a_silent_robot_is_given_up() -> None:
    robot = Robot()
    robot.failure = NoAnswerError("it did not answer", robot="arm-1", verb="leadTo")
    with robot.lead() as lead:
        lead.send({"pan": 0.0})
        eventually(lambda: lead.unanswered == 1)
        robot.at = LOST_S + 1
        with pytest.raises(NoAnswerError, match="answered no command for 10 s"):
            lead.send({"pan": 0.0})


def test_turn_begins_at_once_with_what_the_leader_has_just_sent() -> None:
    robot = Robot()
    with robot.lead(policy=True) as lead:
        lead.send({"pan": 0.3}, picture_age_s=0.1)
        eventually(lambda: lead.state.state == "led")
        robot.at = 0.02
        lead.grip()
        eventually(lambda: len(robot.commands) == 2)
    taken = robot.commands[1]
    assert (taken["turn"], taken["leads"], taken["targets"], taken["seq"]) == (2, True, {"pan": 0.3}, 2)
    assert (taken["made"], taken["picture_age_ms"]) == (0.0, 100.0), "it is no younger than it was"
