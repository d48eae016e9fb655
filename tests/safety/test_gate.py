"""Permits: given, voided, withdrawn, and refused while locked."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from strands_robots.envelope import Envelope, error
from strands_robots.safety import gate as module
from strands_robots.safety.gate import MotionGate, MotionRefused, Permit


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
    assert [permit.valid for permit in (after, before[0])] == [False, False]


def test_a_withdrawn_permit_is_void_alone() -> None:
    gate = MotionGate()
    one, other = gate.permit("a"), gate.permit("b")
    one.withdraw()
    assert (one.valid, one.revoked, other.valid) == (False, False, True)
    gate.revoke()
    assert one.revoked


def test_a_locked_gate_gives_no_permit_and_says_why() -> None:
    gate = MotionGate()
    latch = Latch()
    gate.attach(latch)
    with pytest.raises(MotionRefused, match="start is locked") as refused:
        gate.permit("start")
    assert refused.value.envelope["status"] == "error"
    assert gate.refusal("step")
    latch.locked = False
    assert gate.permit("start").valid


def test_a_halt_that_comes_while_a_permit_is_given_refuses_it() -> None:
    gate = MotionGate()

    class Racing(Latch):
        def refusal(self, verb: str) -> Envelope | None:
            gate.revoke()
            return None

    gate.attach(Racing())
    with pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.permit("start")


def test_a_halt_voids_the_permits_of_whoever_halts_at_the_same_time() -> None:
    gate = MotionGate()
    void: list[bool] = []

    def revoke() -> None:
        for _ in range(500):
            try:
                permit = gate.permit("x")
            except MotionRefused:
                # Another thread's halt fell into the asking: nothing was given that could be void.
                void.append(True)
                continue
            gate.revoke()
            void.append(not permit.valid)

    threads = [threading.Thread(target=revoke) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert void == [True] * 2000


def test_a_motion_asked_for_before_a_halt_is_refused_when_its_turn_comes_after() -> None:
    gate = MotionGate()
    request = gate.request()
    gate.revoke()
    with pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.permit("start", request)
    assert gate.permit("start").valid, "what is asked for after the halt may move"


def test_a_motion_asked_for_at_this_generation_is_given_its_permit() -> None:
    gate = MotionGate()
    permit = gate.permit("start", gate.request())
    assert permit.valid
    gate.revoke()
    assert not permit.valid


def test_a_request_to_a_robot_that_has_this_one_inside_is_refused_after_a_halt_of_either() -> None:
    gate, outer = MotionGate(), MotionGate()
    request = outer.request()
    permit = gate.permit("start", request)
    assert permit.valid
    gate.revoke()
    assert not permit.valid
    outer.revoke()
    with pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.permit("start", request)


def test_a_strangers_code_is_refused_what_a_halt_has_overtaken() -> None:
    gate = MotionGate()
    request = gate.request()
    gate.revoke()
    with gate.within(request), pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.permit("start")
    assert gate.permit("start").valid


def test_a_read_is_given_no_permit_by_a_request_of_its_own() -> None:
    gate = MotionGate()
    with gate.reading("look"), pytest.raises(MotionRefused, match="look is declared a read"):
        gate.permit("start", gate.request())


def test_the_request_of_a_strangers_code_belongs_to_one_thread() -> None:
    gate, seen = MotionGate(), []
    request = gate.request()
    gate.revoke()
    with gate.within(request):
        other = threading.Thread(target=lambda: seen.append(gate.refusal("start")))
        other.start()
        other.join(20)
    assert seen == [None]


def test_every_latch_of_a_robot_has_to_be_free_before_it_moves() -> None:
    gate = MotionGate()
    first, second = Latch(), Latch(locked=False)
    gate.attach(first)
    gate.attach(second)
    assert gate.refusal("start") is not None, "a second network does not unlock what the first one locked"
    gate.detach(second)
    assert gate.refusal("start") is not None
    gate.detach(first)
    assert gate.permit("start").valid


def test_giving_up_a_call_voids_what_it_began_and_nothing_else() -> None:
    gate = MotionGate()
    other, request = gate.permit("wave"), gate.request()
    begun = gate.permit("start", request)
    request.give_up()
    assert (begun.valid, begun.revoked, other.valid) == (False, False, True)
    with pytest.raises(MotionRefused):
        gate.permit("start", request)


def test_a_call_inside_a_call_is_as_old_as_the_outer_one() -> None:
    gate = MotionGate()
    old = gate.request()
    gate.revoke()
    with gate.within(old):
        with gate.within(gate.request()):
            assert gate.refusal("start") is not None
        assert gate.refusal("start") is not None, "the outer call goes on being old"
    assert gate.refusal("start") is None


def test_a_permit_that_waited_says_so_when_it_is_void() -> None:
    gate = MotionGate()
    permit = gate.permit("start")
    permit.check()
    gate.revoke()
    with pytest.raises(MotionRefused, match="halted after it was asked for"):
        permit.check()


def test_a_motion_that_stops_everything_else_first_goes_on_with_a_fresh_permit() -> None:
    gate = MotionGate()
    mine, other = gate.permit("reset"), gate.permit("wave")
    fresh = gate.renew(mine)
    assert [permit.valid for permit in (fresh, mine, other)] == [True, False, False]
    gate.revoke()
    assert not fresh.valid


def test_a_motion_is_not_renewed_over_a_halt_or_a_lock() -> None:
    gate = MotionGate()
    permit = gate.permit("reset")
    gate.revoke()
    with pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.renew(permit)
    permit = gate.permit("reset")
    gate.attach(Latch())
    with pytest.raises(MotionRefused, match="locked"):
        gate.renew(permit)


def test_a_refused_renewal_builds_its_answer_after_it_has_let_go_of_the_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate, held = MotionGate(), []
    permit = gate.permit("reset")
    gate.revoke()

    def answer(reason: str) -> Envelope:
        held.append(gate._counting.locked())
        return error(reason)

    monkeypatch.setattr(module, "error", answer)
    with pytest.raises(MotionRefused, match="halted after it was asked for"):
        gate.renew(permit)
    assert held == [False]


def revoked(gate: MotionGate, permit: Permit) -> Permit:
    """Revoke, as a halt does; return the permit of that halt's settling."""
    return gate.settling(gate.revoke())


@pytest.mark.parametrize("first", [revoked, MotionGate.renew])
def test_what_comes_after_a_halt_never_takes_its_place(
    first: Callable[[MotionGate, Permit], Permit], monkeypatch: pytest.MonkeyPatch
) -> None:
    second_ran = threading.Event()

    class TellingLock:
        """A lock that tells of the thread that waits for it."""

        def __init__(self) -> None:
            self._lock = threading.Lock()

        def __enter__(self) -> None:
            if not self._lock.acquire(blocking=False):
                second_ran.set()
                self._lock.acquire()

        def __exit__(self, *_: object) -> None:
            self._lock.release()

    class SecondHaltBeforeEachStore(MotionGate):
        def __setattr__(self, name: str, value: Any) -> None:
            if name == "generation" and value == 1:
                second.start()
                assert second_ran.wait(20)
            super().__setattr__(name, value)

    def halt() -> None:
        newest.append(gate.revoke())
        second_ran.set()

    newest: list[int] = []
    second = threading.Thread(target=halt)
    with monkeypatch.context() as patch:
        patch.setattr(module, "threading", SimpleNamespace(Lock=TellingLock, local=threading.local))
        gate = SecondHaltBeforeEachStore()
    permit = first(gate, gate.permit("reset"))
    second.join(20)
    assert gate.generation == newest[0], "the older halt is stored after the newer"
    assert not permit.valid, "a halt is lost"


def test_refusals_of_a_locked_robot_are_told_and_no_flood_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, str]] = []

    class Lock(Latch):
        def refusal(self, verb: str) -> Envelope | None:
            return error(f"{verb} is locked.", locked=True) if self.locked else None

    gate = MotionGate(lock := Lock())
    unwatch = gate.watch_refusals(lambda verb, why: told.append((verb, why)))
    gate.watch_refusals(lambda verb, why: 1 / 0)
    for _ in range(50):
        with pytest.raises(MotionRefused):
            gate.permit("a")
    assert told == [("a", "a is locked.")], "a caller that asks on and on"
    monkeypatch.setattr(module, "REFUSED_EVERY_S", 0.0)
    with pytest.raises(MotionRefused):
        gate.permit("b")
    lock.locked = False
    gate.attach(Latch())
    with pytest.raises(MotionRefused):
        gate.permit("c")
    unwatch()
    lock.locked = True
    with pytest.raises(MotionRefused):
        gate.permit("d")
    assert [verb for verb, _ in told] == ["a", "b"], "what refuses for another reason is no lockout"
