"""Outcome of a stop as the roster measures it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from strands_robots.safety.answers import Answers, Received
from strands_robots.safety.controller import StopReport
from strands_robots.safety.identity import ROBOTS, KeyFile
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_roster import StopOutcome, StopRoster

NETWORK = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
EPOCH = "0" * 32
VERDICT = {"device_id": "arm-1", "estop_id": EPOCH, "stopped": True, "halted": ["policy"]}


def outcome(verdict: Mapping[str, Any]) -> StopOutcome:
    """Measure a stop that ``arm-1`` alone answered."""
    answers = Answers({}, required=False, pressed_at=0.0)
    answers.take("arm-1", Received(verdict, 1.0, 0.0))
    roster = StopRoster(NETWORK)
    roster.read()
    return roster.outcome(StopReport(EPOCH, answers.by_robot, {}, {}, (), True, 1.0))


@pytest.fixture
def served() -> None:
    sightings().serve(NETWORK, "arm-1")


@pytest.mark.usefixtures("served")
def test_unsigned_answer_of_a_robot_that_is_served_here_is_a_claim() -> None:
    identity = KeyFile(ROBOTS, "arm-1").load_or_make()
    claimed = outcome(VERDICT)
    assert (claimed.ok, list(claimed.report.claimed)) == (False, ["arm-1"])
    other = KeyFile(ROBOTS, "arm-2").load_or_make()
    assert not outcome(signed(other, Purpose.STOP_VERDICT, "arm-1", VERDICT)).ok
    own = outcome(signed(identity, Purpose.STOP_VERDICT, "arm-1", VERDICT))
    assert (own.ok, list(own.report.stopped)) == (True, ["arm-1"])


@pytest.mark.usefixtures("served")
def test_robot_that_is_served_here_without_a_key_may_answer_unsigned() -> None:
    assert outcome(VERDICT).ok


def test_robot_of_another_machine_that_is_not_enrolled_may_answer_unsigned() -> None:
    KeyFile(ROBOTS, "arm-1").load_or_make()
    assert outcome(VERDICT).ok
