"""Grades of the answers to a stop: the robot's own, claims of strangers, wrong keys, and which of two counts."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest

from strands_robots.safety.answers import RUNS_MAX, Answers, Received
from strands_robots.safety.identity import ROBOTS, KeyFile, SigningIdentity
from strands_robots.safety.statements import Proof, Purpose, signed

ESTOP_ID = "e" * 32


@pytest.fixture
def robot(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "arm-1", tmp_path).load_or_make()


@pytest.fixture
def stranger(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "stranger", tmp_path).load_or_make()


def answers(*robots: SigningIdentity, required: bool = False) -> Answers:
    return Answers({each.name: each.public for each in robots}, required=required, pressed_at=100.0)


def verdict(stopped: bool | None, identity: SigningIdentity | None = None, **more: Any) -> Received:
    fields = {"estop_id": ESTOP_ID, "stopped": stopped, **more}
    if stopped is False:
        fields["not_stopped"] = {"arm": "no answer in 1 s"}
    params = signed(identity, Purpose.STOP_VERDICT, "arm-1", fields) if identity else fields
    return Received(params, 5.0, 100.005)


def outcome(book: Answers, *received: Received) -> tuple[bool | None, bool]:
    """Return what counts for the robot, and whether it is only claimed."""
    for each in received:
        book.take("arm-1", each)
    return book.by_robot["arm-1"].stopped, book.by_robot["arm-1"].claimed


def test_where_nothing_is_configured_every_answer_counts(robot: SigningIdentity) -> None:
    for received in (verdict(True), verdict(True, robot)):
        book = answers()
        assert outcome(book, received) == (True, False)
        assert book.settled() == {"arm-1"}


def test_an_enrolled_robot_answers_for_itself(robot: SigningIdentity) -> None:
    book = answers(robot)
    assert outcome(book, verdict(True, robot)) == (True, False)
    assert book.by_robot["arm-1"].proof is Proof.SIGNED


def test_an_unsigned_answer_of_an_enrolled_robot_is_claimed_and_leaves_it_unsettled(robot: SigningIdentity) -> None:
    book = answers(robot)
    assert outcome(book, verdict(True)) == (True, True)
    assert book.unsettled(["arm-1", "arm-2"]) == ("arm-1", "arm-2")


def test_where_signatures_are_required_a_robot_without_an_enrolled_key_is_claimed(robot: SigningIdentity) -> None:
    assert outcome(answers(required=True), verdict(True, robot)) == (True, True)
    assert outcome(answers(required=True), verdict(True)) == (True, True)


def test_a_wrong_key_is_an_alarm_and_no_answer(robot: SigningIdentity, stranger: SigningIdentity) -> None:
    book = answers(robot)
    assert book.take("arm-1", verdict(True, stranger))
    assert not book.take("arm-1", verdict(True, stranger))
    assert book.by_robot == {}
    assert set(book.alarms) == {"arm-1"}


def test_the_robots_own_answer_counts_among_claims_in_any_order(robot: SigningIdentity) -> None:
    said = [verdict(True), verdict(False, robot), verdict(True), verdict(None)]
    for order in itertools.permutations(said):
        assert outcome(answers(robot), *order) == (False, False)
    for order in itertools.permutations([verdict(False), verdict(True, robot), verdict(None)]):
        assert outcome(answers(robot), *order) == (True, False)


@pytest.mark.parametrize("required", [False, True])
def test_among_unsigned_answers_not_stopped_outranks_stopped_in_any_order(required: bool) -> None:
    for order in itertools.permutations([verdict(True), verdict(False), verdict(None), verdict(True)]):
        assert outcome(answers(required=required), *order)[0] is False


def test_a_robot_of_unknown_state_that_stops_has_stopped() -> None:
    for order in itertools.permutations([verdict(True), verdict(None)]):
        assert outcome(answers(), *order) == (True, False)


def test_of_two_signed_answers_the_later_statement_counts_in_any_order(robot: SigningIdentity) -> None:
    slow = verdict(False, robot)
    late = verdict(True, robot, late=True)
    assert outcome(answers(robot), slow, late, slow) == (True, False)
    assert outcome(answers(robot), late, slow) == (True, False)
    stopped = verdict(True, robot)
    moved_again = verdict(False, robot)
    assert outcome(answers(robot), moved_again, stopped) == (False, False)


def test_a_robot_that_was_resumed_since_has_stopped_all_the_same(robot: SigningIdentity) -> None:
    stopped = verdict(True, robot)
    resumed = verdict(None, robot, unknown={"arm-1": "this stop was resumed before it came again"})
    for order in itertools.permutations([stopped, resumed]):
        assert outcome(answers(robot), *order)[0] is True


def test_the_delay_from_the_press_is_corrected_by_the_robots_clock() -> None:
    book = answers()
    # The robot's clock is 30 s ahead; the stop left 11 s after the press and took 10 ms, its answer too.
    fields = {"estop_id": ESTOP_ID, "stopped": True, "sent_at": 111.0, "received_at": 141.01, "t": 141.05}
    book.take("arm-1", Received(fields, 11_060.0, 111.06))
    assert book.by_robot["arm-1"].delay_s == pytest.approx(11.01)


@pytest.mark.parametrize("clock", [{}, {"received_at": "soon"}, {"received_at": True}, {"received_at": 1.0}])
def test_without_the_robots_clock_no_delay_is_stated(clock: dict[str, Any]) -> None:
    book = answers()
    book.take("arm-1", verdict(True, **clock))
    assert book.by_robot["arm-1"].delay_s is None


def test_a_process_that_moves_on_outweighs_another_one_of_its_name(robot: SigningIdentity) -> None:
    for order in itertools.permutations([verdict(True, robot, run="a"), verdict(False, robot, run="b")]):
        book = answers(robot)
        assert outcome(book, *order) == (False, False)
        assert {run: each.stopped for run, each in book.by_robot["arm-1"].runs.items()} == {"a": True, "b": False}


def test_a_process_that_stops_after_all_is_one_that_stopped(robot: SigningIdentity) -> None:
    book = answers(robot)
    assert outcome(book, verdict(False, robot, run="a"), verdict(True, robot, run="a")) == (True, False)


def test_an_unsigned_answer_stands_for_no_process_of_an_enrolled_robot(robot: SigningIdentity) -> None:
    book = answers(robot)
    assert outcome(book, verdict(True, robot, run="a"), verdict(True, run="b")) == (True, False)
    assert set(book.by_robot["arm-1"].runs) == {"a", ""}
    assert book.by_robot["arm-1"].runs[""].claimed


def test_made_up_processes_hide_no_answer_and_take_no_memory() -> None:
    book = answers()
    assert outcome(book, *(verdict(True, run=f"made-up {each}") for each in range(100))) == (True, False)
    assert outcome(book, verdict(True, run="x" * 100), verdict(False, run="a")) == (False, False)
    assert len(book.by_robot["arm-1"].runs) <= RUNS_MAX + 1
