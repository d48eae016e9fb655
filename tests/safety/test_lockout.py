"""The lockout's state machine, case by case and by hypothesis."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule

from strands_robots.envelope import is_error, text_of
from strands_robots.safety.gate import MotionGate, MotionRefused
from strands_robots.safety.latch import SEEN_MAX, LockoutLatch
from strands_robots.safety.lockout import (
    MAX_EPOCHS,
    OVERFLOW,
    Cleared,
    ClearLocal,
    Duplicate,
    Engage,
    Engaged,
    Hold,
    LockoutState,
    NotHeld,
    Resume,
    refusal,
    step,
)

FREE = LockoutState()


def epoch(number: int) -> str:
    return f"{number:032x}"


def locked(*numbers: int) -> LockoutState:
    state = FREE
    for number in numbers:
        state, _ = step(state, Engage(epoch(number), "safety-1", "test"), float(number))
    return state


def test_a_stop_locks_and_says_who_when_and_why() -> None:
    state, effect = step(FREE, Engage(epoch(1), "safety-1", "smoke"), 12.5)
    assert effect == Engaged(Hold(epoch(1), "safety-1", "smoke", 12.5), first=True)
    assert state.locked
    assert state.epochs == (epoch(1),)


def test_the_same_epoch_again_changes_nothing() -> None:
    state, effect = step(locked(1), Engage(epoch(1), "other", "other"), 99.0)
    assert effect == Duplicate(epoch(1))
    assert state == locked(1)


def test_two_stops_need_two_resumes_in_any_order() -> None:
    for order in itertools.permutations((1, 2, 3)):
        state = locked(1, 2, 3)
        for left, number in zip((2, 1, 0), order, strict=True):
            assert state.locked
            state, effect = step(state, Resume(epoch(number)), 0.0)
            assert isinstance(effect, Cleared)
            assert effect.free is (left == 0)
        assert state == FREE


def test_a_resume_of_an_epoch_not_held_clears_nothing() -> None:
    assert step(locked(1), Resume(epoch(2)), 0.0) == (locked(1), NotHeld(epoch(2)))
    assert step(FREE, Resume(epoch(2)), 0.0) == (FREE, NotHeld(epoch(2)))


def test_a_local_clear_frees_everything_and_says_what() -> None:
    state, effect = step(locked(1, 2), ClearLocal("ann"), 0.0)
    assert state == FREE
    assert isinstance(effect, Cleared)
    assert [hold.epoch for hold in effect.holds] == [epoch(1), epoch(2)]
    assert step(FREE, ClearLocal("ann"), 0.0) == (FREE, NotHeld(""))


def test_the_65th_stop_locks_under_the_overflow_epoch_that_only_a_local_clear_frees() -> None:
    state = locked(*range(MAX_EPOCHS))
    state, effect = step(state, Engage(epoch(900), "safety-9", "more"), 7.0)
    assert effect == Engaged(Hold(OVERFLOW, "safety-9", "more", 7.0), first=False)
    assert step(state, Engage(epoch(901), "x", ""), 8.0) == (state, Duplicate(OVERFLOW))
    for number in range(MAX_EPOCHS):
        state, _ = step(state, Resume(epoch(number)), 0.0)
    state, effect = step(state, Resume(OVERFLOW), 0.0)
    assert effect == NotHeld(OVERFLOW)
    assert state.locked
    assert step(state, ClearLocal("ann"), 0.0)[0] == FREE


def test_a_refusal_names_the_epoch_who_stopped_it_and_how_to_resume() -> None:
    assert refusal(FREE, "arm-1", "execute") is None
    answer = refusal(locked(1, 2), "arm-1", "execute")
    assert answer is not None
    assert is_error(answer)
    for part in ("execute", "arm-1", epoch(1), "safety-1", "test", "1 more stop", "resume --key", "1970-01-01"):
        assert part in text_of(answer)
    assert answer["epochs"] == [epoch(1), epoch(2)]


def test_a_refusal_under_overflow_offers_only_the_local_clear() -> None:
    state, _ = step(locked(*range(MAX_EPOCHS)), Engage(epoch(99), "s", ""), 0.0)
    answer = refusal(state, "arm-1", "execute")
    assert answer is not None
    assert "--local" in text_of(answer)
    assert "--key" not in text_of(answer)


@pytest.mark.parametrize("at", [1e300, -1e300, float("nan")])
def test_a_time_that_no_calendar_holds_still_gives_a_refusal(at: float) -> None:
    state, _ = step(FREE, Engage(epoch(1)), at)
    assert refusal(state, "arm-1", "execute") is not None


def test_a_latched_gate_refuses_motion_and_voids_the_permit_given_before() -> None:
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


def test_an_id_seen_before_does_not_engage_again_after_its_resume() -> None:
    latch = LockoutLatch("arm-1")
    assert isinstance(latch.engage(epoch(1), "s", ""), Engaged)
    latch.resume(epoch(1))
    assert latch.engage(epoch(1), "s", "") is None
    assert not latch.state.locked


def test_the_id_cache_forgets_the_oldest_but_never_a_held_epoch() -> None:
    latch = LockoutLatch("arm-1")
    latch.engage(epoch(0), "s", "")
    for number in range(1, SEEN_MAX + MAX_EPOCHS + 50):
        latch.engage(epoch(number), "s", "")
        latch.resume(epoch(number))
    assert len(latch.seen) == SEEN_MAX + MAX_EPOCHS
    assert epoch(0) in latch.seen
    assert epoch(1) not in latch.seen


class Lockout(RuleBasedStateMachine):
    """The machine beside a model: a set of epochs and a flag for the overflow."""

    epochs = Bundle("epochs")

    def __init__(self) -> None:
        super().__init__()
        self.state = FREE
        self.held: set[str] = set()
        self.overflow = False
        self.now = 0.0

    def advance(self, event: Engage | Resume | ClearLocal) -> object:
        self.now += 1.0
        self.state, effect = step(self.state, event, self.now)
        return effect

    @rule(target=epochs, number=st.integers(0, 200))
    def new_epoch(self, number: int) -> str:
        return epoch(number)

    @rule(wanted=epochs)
    def engage(self, wanted: str) -> None:
        self.advance(Engage(wanted, "s", "r"))
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
        effect = self.advance(Resume(wanted))
        assert isinstance(effect, Cleared) is (wanted in self.held)
        self.held.discard(wanted)

    @rule()
    def resume_overflow(self) -> None:
        assert isinstance(self.advance(Resume(OVERFLOW)), NotHeld)

    @rule()
    def clear(self) -> None:
        self.advance(ClearLocal("ann"))
        self.held, self.overflow = set(), False

    @invariant()
    def agrees_with_the_model(self) -> None:
        assert set(self.state.resumable) == self.held
        assert len(self.state.holds) == len(self.held) <= MAX_EPOCHS
        assert (self.state.overflow is not None) is self.overflow
        assert self.state.locked is (bool(self.held) or self.overflow)
        assert (refusal(self.state, "arm", "execute") is not None) is self.state.locked
        assert [hold.at for hold in self.state.holds] == sorted(hold.at for hold in self.state.holds)


TestLockoutMachine = Lockout.TestCase
TestLockoutMachine.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)
