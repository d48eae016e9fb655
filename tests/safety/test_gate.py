"""Permits: given, voided, withdrawn, and refused while locked."""

from __future__ import annotations

import threading

import pytest

from strands_robots.envelope import Envelope, error
from strands_robots.safety.gate import MotionGate, MotionRefused


class Latch:
    def __init__(self, locked: bool = True) -> None:
        self.locked = locked

    def refusal(self, verb: str) -> Envelope | None:
        return error(f"{verb} is locked.") if self.locked else None


def test_a_halt_voids_every_permit_given_so_far_and_none_given_after() -> None:
    gate = MotionGate()
    before = [gate.permit("a"), gate.permit("b")]
    gate.revoke()
    after = gate.permit("c")
    assert [permit.valid for permit in before] == [False, False]
    assert after.valid
    gate.revoke()
    assert not after.valid
    assert not before[0].valid


def test_a_withdrawn_permit_is_void_alone() -> None:
    gate = MotionGate()
    one, other = gate.permit("a"), gate.permit("b")
    one.withdraw()
    assert (one.valid, one.revoked, other.valid) == (False, False, True)
    gate.revoke()
    assert one.revoked


def test_a_locked_gate_gives_no_permit_and_says_why() -> None:
    gate = MotionGate()
    gate.attach(Latch())
    with pytest.raises(MotionRefused, match="start is locked") as refused:
        gate.permit("start")
    assert refused.value.envelope["status"] == "error"
    assert gate.refusal("step") is not None
    gate.attach(Latch(locked=False))
    assert gate.permit("start").valid


def test_a_lock_that_engages_while_a_permit_is_given_voids_it() -> None:
    gate = MotionGate()

    class Racing(Latch):
        def refusal(self, verb: str) -> Envelope | None:
            gate.revoke()
            return None

    gate.attach(Racing())
    assert not gate.permit("start").valid


def test_generations_rise_whoever_revokes() -> None:
    gate = MotionGate()
    seen: list[int] = []

    def revoke() -> None:
        for _ in range(500):
            permit = gate.permit("x")
            gate.revoke()
            assert not permit.valid
            seen.append(gate.generation)

    threads = [threading.Thread(target=revoke) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 2000


def test_a_motion_asked_for_before_a_halt_is_refused_when_its_turn_comes_after() -> None:
    gate = MotionGate()
    asked = gate.generation
    gate.revoke()
    with gate.asked_at(asked), pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.permit("start")
    assert gate.permit("start").valid, "what is asked for after the halt may move"


def test_a_motion_asked_for_at_this_generation_is_given_its_permit() -> None:
    gate = MotionGate()
    with gate.asked_at(gate.generation):
        permit = gate.permit("start")
    assert permit.valid


def test_the_moment_of_asking_belongs_to_one_thread() -> None:
    gate, seen = MotionGate(), []
    asked = gate.generation
    gate.revoke()
    with gate.asked_at(asked):
        other = threading.Thread(target=lambda: seen.append(gate.refusal("start")))
        other.start()
        other.join(5)
    assert seen == [None]
