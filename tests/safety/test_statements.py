"""A statement is signed for one purpose, by one source, over every field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from strands_robots.safety.identity import ROBOTS, KeyFile, SigningIdentity
from strands_robots.safety.statements import Proof, Purpose, own_key, proof_of, signed

VERDICT = Purpose.STOP_VERDICT
FIELDS = {"estop_id": "e" * 32, "stopped": True, "halted": ["policy"], "elapsed_ms": 1.25, "not_stopped": {}}


@pytest.fixture
def robot(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "arm-1", tmp_path).load_or_make()


@pytest.fixture
def stranger(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "stranger", tmp_path).load_or_make()


def over_the_wire(statement: dict[str, Any]) -> dict[str, Any]:
    """Return the statement as a reader gets it, with the envelope's own fields."""
    params: dict[str, Any] = json.loads(json.dumps({**statement, "event_id": "1", "ts": "now"}))
    return params


def test_a_statement_of_an_enrolled_robot_is_signed(robot: SigningIdentity) -> None:
    statement = over_the_wire(signed(robot, VERDICT, "arm-1", FIELDS))
    assert proof_of(VERDICT, "arm-1", statement, robot.public) is Proof.SIGNED
    assert own_key(VERDICT, "arm-1", statement) == robot.public
    assert {name: statement[name] for name in FIELDS} == FIELDS
    assert statement["purpose"] == "stop-verdict"


def test_without_an_identity_or_an_enrolled_key_it_is_claimed(robot: SigningIdentity) -> None:
    assert proof_of(VERDICT, "arm-1", signed(None, VERDICT, "arm-1", FIELDS), robot.public) is Proof.CLAIMED
    assert proof_of(VERDICT, "arm-1", FIELDS, robot.public) is Proof.CLAIMED
    assert proof_of(VERDICT, "arm-1", signed(robot, VERDICT, "arm-1", FIELDS), None) is Proof.CLAIMED


def test_another_key_than_the_enrolled_one_is_wrong(robot: SigningIdentity, stranger: SigningIdentity) -> None:
    theirs = signed(stranger, VERDICT, "arm-1", FIELDS)
    assert proof_of(VERDICT, "arm-1", theirs, robot.public) is Proof.WRONG
    assert proof_of(VERDICT, "arm-1", {**theirs, "key": robot.public_text}, robot.public) is Proof.WRONG


@pytest.mark.parametrize(
    "change",
    [
        {"stopped": False},
        {"stopped": None},
        {"elapsed_ms": 1.26},
        {"estop_id": "f" * 32},
        {"t": 0},
        {"more": 1},
        {"sig": "A" * 86},
        {"sig": None},
        {"sig": 7},
        {"key": None},
        {"elapsed_ms": float("nan")},
    ],
)
def test_a_changed_field_is_wrong(robot: SigningIdentity, change: dict[str, Any]) -> None:
    statement = {**signed(robot, VERDICT, "arm-1", FIELDS), **change}
    assert proof_of(VERDICT, "arm-1", statement, robot.public) is Proof.WRONG
    assert own_key(VERDICT, "arm-1", statement) is None


@pytest.mark.parametrize("other", [each for each in Purpose if each is not VERDICT])
def test_a_statement_for_another_purpose_is_wrong(robot: SigningIdentity, other: Purpose) -> None:
    statement = {**signed(robot, other, "arm-1", FIELDS), "purpose": VERDICT.value}
    assert proof_of(VERDICT, "arm-1", statement, robot.public) is Proof.WRONG


def test_a_statement_of_another_source_is_wrong(robot: SigningIdentity) -> None:
    statement = signed(robot, VERDICT, "arm-2", FIELDS)
    assert proof_of(VERDICT, "arm-1", statement, robot.public) is Proof.WRONG
