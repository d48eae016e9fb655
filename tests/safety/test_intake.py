"""The queue in front of the lane."""

from __future__ import annotations

import threading

from strands_robots.safety.intake import TRAY_MAX, Heard, Intake


def drained(intake: Intake) -> list[Heard]:
    intake.close()
    found = []
    while (heard := intake.take()) is not None:
        found.append(heard)
    return found


def test_what_was_offered_is_taken() -> None:
    intake = Intake()
    intake.offer("emergencyStop", "safety-1", b"x")
    heard = intake.take()
    assert heard is not None
    assert (heard.event, heard.source, heard.payload) == ("emergencyStop", "safety-1", b"x")
    assert drained(intake) == []


def test_a_flood_of_one_source_does_not_stand_before_another() -> None:
    intake = Intake()
    for number in range(200):
        for forged in range(50):
            intake.offer("emergencyStop", "forger", str(forged).encode())
        intake.offer("emergencyStop", f"safety-{number}", b"true")
        taken = [intake.take(), intake.take()]
        assert any(heard is not None and heard.payload == b"true" for heard in taken)


def test_the_newest_of_a_source_comes_first_and_memory_is_bounded() -> None:
    intake = Intake()
    for number in range(1000):
        intake.offer("emergencyStop", "s", str(number).encode())
    found = drained(intake)
    assert [heard.payload for heard in found] == [str(n).encode() for n in range(999, 999 - TRAY_MAX, -1)]


def test_a_check_in_comes_after_a_stop_and_never_pushes_one_out() -> None:
    intake = Intake()
    intake.offer("emergencyStop", "s", b"stop")
    for _ in range(100):
        intake.offer("safetyCheckIn", "s", b"", urgent=False)
    assert drained(intake)[0].event == "emergencyStop"


def test_taking_waits_for_an_offer_and_ends_with_the_intake() -> None:
    intake, found = Intake(), []

    def take() -> None:
        while (heard := intake.take()) is not None:
            found.append(heard.payload)

    thread = threading.Thread(target=take)
    thread.start()
    for number in range(100):
        intake.offer("emergencyStop", f"s{number}", str(number).encode())
    intake.close()
    thread.join(20)
    assert sorted(map(int, found)) == list(range(100))
