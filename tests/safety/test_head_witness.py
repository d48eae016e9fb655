"""Which heads of other machines' audits are written down, and how often."""

from __future__ import annotations

from typing import Any

import pytest

from strands_robots.safety import checkin
from strands_robots.safety.checkin import CheckInAnswers, HeadWitness, chosen

OWN = "0" * 32


def log(number: int) -> str:
    return f"{number + 1:032x}"


def answer(number: int, count: int = 1) -> dict[str, Any]:
    return {"audit": {"log": log(number), "count": count, "last": f"{number * 1000 + count:064x}"}}


class Clock:
    """Seconds that pass when a test says so."""

    at = 1000.0

    def __call__(self) -> float:
        return self.at


def witness(clock: Clock, written: list[Any], *, always: bool = False, own: str = OWN) -> HeadWitness:
    def write(by: str, robot_id: str, head: Any, *, signed: bool) -> None:
        written.append((by, robot_id, head["count"], signed))

    return HeadWitness(always=always, own=lambda: own, write=write, clock=clock)


def test_three_machines_are_chosen_and_all_of_them_choose_alike() -> None:
    audits = {log(number) for number in range(20)}
    for subject in audits:
        first = chosen(subject, audits)
        assert len(first) == 3
        assert subject not in first
        assert first == chosen(subject, audits - {subject})
    # It is spread: no machine witnesses all the others.
    counts = [sum(each in chosen(subject, audits) for subject in audits) for each in audits]
    assert max(counts) < 10


@pytest.mark.parametrize("name", ["\ud800" * 32, "z" * 32, "A" * 32, "0" * 31 + "\n"])
def test_head_of_a_log_with_an_impossible_name_is_left_out(name: str) -> None:
    clock, written = Clock(), list[Any]()
    receiver = witness(clock, written)
    assert not receiver.receive("stranger", {"audit": {**answer(1)["audit"], "log": name}}, by="me")
    assert receiver.receive("arm-2", answer(2), by="me")
    assert written == [("me", "arm-2", 1, False)]


def test_each_audit_of_a_fleet_is_written_by_three_machines() -> None:
    clock, fleet = Clock(), range(12)
    written: dict[int, list[Any]] = {number: [] for number in fleet}
    robots = {number: witness(clock, written[number], own=log(number)) for number in fleet}
    for _ in range(2):  # all audits are known after the first round of answers
        for subject in fleet:
            for each in robots.values():
                each.receive(f"arm-{subject}", answer(subject), by="me")
        clock.at += 60.0
        for lines in written.values():
            lines.clear()
        for subject in fleet:
            for each in robots.values():
                each.receive(f"arm-{subject}", answer(subject, 2), by="me")
    seen = [line[1] for lines in written.values() for line in lines]
    assert all(seen.count(f"arm-{subject}") <= 3 for subject in fleet)


def test_head_is_written_at_most_once_a_minute_and_only_when_it_is_another() -> None:
    clock, written = Clock(), list[Any]()
    controller = witness(clock, written, always=True)
    for second in range(120):
        clock.at = 1000.0 + second
        controller.receive("arm-1", answer(1, second + 1), by="safety-1")
    assert [line[2] for line in written] == [1, 61]
    clock.at += 100.0
    assert not controller.receive("arm-1", answer(1, 61), by="safety-1")
    assert not controller.receive("arm-1", {"audit": {"log": OWN, "count": 5, "last": "a" * 64}}, by="safety-1")
    assert controller.receive("arm-1", answer(1, 121), by="safety-1")


def test_flood_of_invented_audits_is_bounded_and_a_proven_head_is_written_all_the_same() -> None:
    clock, written = Clock(), list[Any]()
    controller = witness(clock, written, always=True)
    for number in range(2000):
        controller.receive(f"ghost-{number}", answer(number), by="safety-1")
    assert len(written) == checkin.CLAIMS_PER_MIN
    assert controller.receive("arm-1", answer(5000), by="safety-1", proven=True)
    assert written[-1] == ("safety-1", "arm-1", 1, True)


def test_answer_that_holds_no_head_is_nothing() -> None:
    written: list[Any] = []
    for value in (None, 7, {}, {"log": "a", "count": 1, "last": "b"}):
        assert not witness(Clock(), written, always=True).receive("arm-1", {"audit": value}, by="safety-1")
    assert written == []


def test_process_answers_one_check_in_in_ten_seconds(monkeypatch: Any) -> None:
    clock = Clock()
    monkeypatch.setattr(checkin, "audit_head", lambda: answer(1)["audit"])
    answers = CheckInAnswers(clock)
    given = []
    for tick in range(100):
        clock.at = 1000.0 + tick * 0.5
        given.append(answers.answer("arm-1", "a" * 32, None))
    assert sum(each is not None for each in given) == 5
    assert given[0] is not None
    assert (given[0]["audit"], given[0]["estop_id"], given[0]["purpose"]) == (
        answer(1)["audit"],
        "a" * 32,
        "check-in-answer",
    )
