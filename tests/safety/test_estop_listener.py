"""Queue of the e-stop listener, and its budget of answers."""

from __future__ import annotations

import threading

import pytest

from strands_robots.safety.estop_listener import LatchAnswers
from strands_robots.safety.stop_link import BUCKET_CAPACITY, BUCKETS, LATER_EVERY, VOUCHED_MAX, FairQueue, StopEvent


def drained(events: FairQueue) -> list[StopEvent]:
    found = []
    while (received := events.take()) is not None:
        found.append(received)
    return found


def test_event_that_was_put_is_returned() -> None:
    events = FairQueue()
    events.put("emergencyStop", "safety-1", b"x")
    received = events.take()
    assert received is not None
    assert (received.event, received.source, received.payload) == ("emergencyStop", "safety-1", b"x")
    assert drained(events) == []


def test_flood_of_one_source_does_not_delay_another() -> None:
    events = FairQueue()
    for number in range(200):
        for forged in range(50):
            events.put("emergencyStop", "forger", str(forged).encode())
        events.put("emergencyStop", f"safety-{number}", b"true")
        taken = [events.take(), events.take()]
        assert any(received is not None and received.payload == b"true" for received in taken)


def test_newest_event_of_a_source_comes_first_and_memory_is_bounded() -> None:
    events = FairQueue()
    for number in range(1000):
        events.put("emergencyStop", "s", str(number).encode())
    found = drained(events)
    assert [received.payload for received in found] == [str(n).encode() for n in range(999, 999 - BUCKET_CAPACITY, -1)]


def test_check_in_is_served_after_a_stop_and_never_displaces_one() -> None:
    events = FairQueue()
    events.put("emergencyStop", "s", b"stop")
    for _ in range(100):
        events.put("safetyCheckIn", "s", b"", urgent=False)
    assert drained(events)[0].event == "emergencyStop"


@pytest.mark.parametrize("vouched", [False, True])
def test_flood_of_stops_in_one_bucket_starves_nothing_that_is_not_urgent(vouched: bool) -> None:
    events, taken = FairQueue(buckets=1), list[str]()
    names = ("safety-1", "safety-1") if vouched else ("forger", "safety-1")
    if vouched:
        events.vouch("safety-1")
    for _ in range(LATER_EVERY):
        for _ in range(2):
            events.put("emergencyStop", names[0], b"")
        for _ in range(100):
            events.put("safetyCheckIn", names[1], b"", urgent=False)
        received = events.take()
        assert received is not None
        taken.append(received.event)
    assert taken == ["emergencyStop"] * (LATER_EVERY - 1) + ["safetyCheckIn"]


def test_two_names_that_share_a_bucket_of_one_queue_need_not_share_one_of_another() -> None:
    def kept() -> int:
        events = FairQueue(buckets=2)
        for _ in range(BUCKET_CAPACITY):
            events.put("emergencyStop", "safety-1", b"")
            events.put("emergencyStop", "safety-2", b"")
        return len(drained(events))

    assert {kept() for _ in range(64)} == {BUCKET_CAPACITY, 2 * BUCKET_CAPACITY}


def test_every_event_of_another_thread_is_taken() -> None:
    events, found = FairQueue(), []

    def put() -> None:
        for number in range(100):
            events.put("emergencyStop", f"s{number}", str(number).encode())

    thread = threading.Thread(target=put)
    thread.start()
    while thread.is_alive():
        found += drained(events)
    found += drained(events)
    assert sorted(int(received.payload) for received in found if isinstance(received.payload, bytes)) == list(
        range(100)
    )


def test_source_that_signed_is_served_within_two_turns_of_any_crowd() -> None:
    events = FairQueue()
    events.vouch("safety-1")
    for number in range(20 * BUCKETS * BUCKET_CAPACITY):
        events.put("emergencyStop", f"forger-{number}", b"forged")
    events.put("emergencyStop", "safety-1", b"true")
    for number in range(20 * BUCKETS * BUCKET_CAPACITY):
        events.put("emergencyStop", f"forger-{number}", b"forged")
    assert b"true" in [received.payload for received in (events.take(), events.take()) if received]


def test_flood_in_the_name_of_a_source_that_signed_leaves_every_second_turn_to_all_others() -> None:
    events = FairQueue()
    events.vouch("safety-1")
    for _ in range(100):
        events.put("emergencyStop", "safety-1", b"forged")
    events.put("emergencyStop", "safety-2", b"true")
    assert b"true" in [received.payload for received in (events.take(), events.take()) if received]
    assert len(drained(events)) == BUCKET_CAPACITY - 1


def test_sources_that_signed_are_bounded_and_the_first_keep_their_share() -> None:
    events = FairQueue()
    for number in range(10 * VOUCHED_MAX):
        events.vouch(f"safety-{number}")
    events.put("emergencyStop", f"safety-{10 * VOUCHED_MAX - 1}", b"last")
    events.put("emergencyStop", "safety-0", b"first")
    assert {received.payload for received in drained(events)} == {b"first", b"last"}


def test_stop_of_a_flood_is_answered_within_a_budget_and_one_that_comes_again_always() -> None:
    answers = LatchAnswers(per_s=3)
    assert sum(answers.allows("arm-1", f"flood-{number}", 10.0) for number in range(1000)) == 3
    assert not answers.allows("arm-1", "true", 10.1)
    assert answers.allows("arm-1", "true", 10.2)
    assert not answers.allows("arm-2", "true", 10.2), "each robot answers for itself"
    assert answers.allows("arm-1", "another", 11.0)
