"""The lockout's state, case by case and by hypothesis."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule

from strands_robots.envelope import is_error, text_of
from strands_robots.safety.gate import MotionGate, MotionRefused
from strands_robots.safety.lockout import (
    MAX_EPOCHS,
    OVERFLOW,
    SEEN_MAX,
    Lockout,
    LockoutLatch,
    LockoutState,
    refusal,
)

FREE = LockoutState()


def epoch(number: int) -> str:
    return f"{number:032x}"


def locked(*numbers: int) -> LockoutState:
    state = FREE
    for number in numbers:
        state = state.engage(Lockout(epoch(number), "safety-1", "test", float(number)))
    return state


def test_stop_locks_and_records_source_reason_and_time() -> None:
    lockout = Lockout(epoch(1), "safety-1", "smoke", 12.5)
    state = FREE.engage(lockout)
    assert state.all == (lockout,)
    assert state.locked
    assert state.epochs == (epoch(1),)


def test_same_epoch_again_changes_nothing() -> None:
    assert locked(1).engage(Lockout(epoch(1), "other", "other", 99.0)) == locked(1)


def test_each_stop_needs_its_own_resume_in_any_order() -> None:
    for order in itertools.permutations((1, 2, 3)):
        state = locked(1, 2, 3)
        for number in order:
            assert state.locked
            assert epoch(number) in state.resumable
            state = state.resume(epoch(number))
            assert epoch(number) not in state.resumable
        assert state == FREE


def test_resume_of_another_epoch_clears_nothing() -> None:
    assert locked(1).resume(epoch(2)) == locked(1)
    assert FREE.resume(epoch(2)) == FREE


def test_local_clear_frees_everything_and_returns_it() -> None:
    latch = LockoutLatch("arm-1", locked(1, 2))
    assert [each.epoch for each in latch.clear()] == [epoch(1), epoch(2)]
    assert latch.state == FREE
    assert latch.clear() == ()


def test_65th_stop_locks_under_the_overflow_epoch_that_only_a_local_clear_frees() -> None:
    state = locked(*range(MAX_EPOCHS)).engage(Lockout(epoch(900), "safety-9", "more", 7.0))
    assert state.overflow == Lockout(OVERFLOW, "safety-9", "more", 7.0)
    assert state.engage(Lockout(epoch(901), "x", "", 8.0)) == state
    for number in range(MAX_EPOCHS):
        state = state.resume(epoch(number))
    state = state.resume(OVERFLOW)
    assert state.locked
    latch = LockoutLatch("arm-1", state)
    latch.clear()
    assert latch.state == FREE


def test_refusal_names_epoch_source_and_how_to_resume() -> None:
    assert refusal(FREE, "arm-1", "execute") is None
    answer = refusal(locked(1, 2), "arm-1", "execute")
    assert answer is not None
    assert is_error(answer)
    for part in ("execute", "arm-1", epoch(1), "safety-1", "test", "1 more stop", "resume --key", "1970-01-01"):
        assert part in text_of(answer)
    assert answer["epochs"] == [epoch(1), epoch(2)]


def test_refusal_under_overflow_offers_only_the_local_clear() -> None:
    state = locked(*range(MAX_EPOCHS), 99)
    answer = refusal(state, "arm-1", "execute")
    assert answer is not None
    assert "--local" in text_of(answer)
    assert "--key" not in text_of(answer)


@pytest.mark.parametrize("at", [1e300, -1e300, float("nan")])
def test_time_beyond_the_calendar_still_gives_a_refusal(at: float) -> None:
    assert refusal(FREE.engage(Lockout(epoch(1), at=at)), "arm-1", "execute") is not None


def test_latched_gate_refuses_motion_and_voids_earlier_permits() -> None:
    gate, latch = MotionGate(), LockoutLatch("arm-1")
    gate.attach(latch)
    permit = gate.permit("execute")
    latch.engage(epoch(1), "safety-1", "")
    gate.revoke()
    assert not permit.valid
    with pytest.raises(MotionRefused, match=epoch(1)):
        gate.permit("execute")
    latch.resume(epoch(1))
    assert gate.permit("execute").valid
    assert not permit.valid


def test_id_seen_before_does_not_engage_again_after_its_resume() -> None:
    latch = LockoutLatch("arm-1")
    assert latch.engage(epoch(1), "s", "")
    latch.resume(epoch(1))
    assert not latch.engage(epoch(1), "s", "")
    assert not latch.state.locked


def test_id_cache_forgets_the_oldest_but_never_an_active_epoch() -> None:
    latch = LockoutLatch("arm-1")
    latch.engage(epoch(0), "s", "")
    for number in range(1, SEEN_MAX + MAX_EPOCHS + 50):
        latch.engage(epoch(number), "s", "")
        latch.resume(epoch(number))
    assert len(latch.seen) == SEEN_MAX + MAX_EPOCHS
    assert epoch(0) in latch.seen
    assert epoch(1) not in latch.seen


class LockoutMachine(RuleBasedStateMachine):
    """The machine beside a model: a set of epochs and a flag for the overflow."""

    epochs = Bundle("epochs")

    def __init__(self) -> None:
        super().__init__()
        self.state = FREE
        self.held: set[str] = set()
        self.overflow = False
        self.now = 0.0

    @rule(target=epochs, number=st.integers(0, 200))
    def new_epoch(self, number: int) -> str:
        return epoch(number)

    @rule(wanted=epochs)
    def engage(self, wanted: str) -> None:
        self.now += 1.0
        self.state = self.state.engage(Lockout(wanted, "s", "r", self.now))
        if wanted not in self.held and len(self.held) >= MAX_EPOCHS:
            self.overflow = True
        else:
            self.held.add(wanted)

    @rule(first=st.integers(0, 200), count=st.integers(1, 80))
    def engage_many(self, first: int, count: int) -> None:
        for number in range(first, first + count):
            self.engage(epoch(number))

    @rule(wanted=epochs)
    def resume(self, wanted: str) -> None:
        before, self.state = self.state, self.state.resume(wanted)
        assert (before != self.state) is (wanted in self.held)
        self.held.discard(wanted)

    @rule()
    def resume_overflow(self) -> None:
        assert self.state.resume(OVERFLOW) == self.state

    @rule()
    def clear(self) -> None:
        latch = LockoutLatch("arm", self.state)
        assert latch.clear() == self.state.all
        self.state = latch.state
        self.held, self.overflow = set(), False

    @invariant()
    def agrees_with_the_model(self) -> None:
        assert set(self.state.resumable) == self.held
        assert len(self.state.lockouts) == len(self.held) <= MAX_EPOCHS
        assert (self.state.overflow is not None) is self.overflow
        assert self.state.locked is (bool(self.held) or self.overflow)
        assert (refusal(self.state, "arm", "execute") is not None) is self.state.locked
        assert [each.at for each in self.state.lockouts] == sorted(each.at for each in self.state.lockouts)


TestLockoutMachine = LockoutMachine.TestCase
TestLockoutMachine.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)
