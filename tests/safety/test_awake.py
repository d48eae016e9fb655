"""The clock that notices that its process did not run."""

from __future__ import annotations

import linecache
import sys
import threading
import time
from types import FrameType
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.safety import process as module
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.process import BEAT_S, HOLD_S, LONG_HOLD_S, PAUSE_S, AwakeClock
from strands_robots.state_files import uptime
from strands_robots.zenoh_session import LEASE_MS


class Hands:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def hands() -> Hands:
    return Hands()


@pytest.fixture
def clock(hands: Hands, monkeypatch: pytest.MonkeyPatch) -> AwakeClock:
    """A clock that runs; its own thread looks once an hour, so that every look is the test's."""
    monkeypatch.setattr(module, "BEAT_S", 3600.0)
    made = AwakeClock(hands)
    made.watch(lambda: None)
    return made


def test_first_look_after_a_pause_holds_every_gate(clock: AwakeClock, hands: Hands) -> None:
    gates = [MotionGate(awake=clock), MotionGate(awake=clock)]
    permits = [gate.permit("move") for gate in gates]
    assert [permit.held for permit in permits] == [False, False]
    hands.now += PAUSE_S
    assert [permit.held for permit in permits] == [True, True]
    assert [permit.valid for permit in permits] == [True, True]
    hands.now += HOLD_S
    assert [permit.held for permit in permits] == [False, False]
    assert (clock.pauses, gates[0].holds) == (1, 1)


def test_pause_in_which_peers_may_have_given_up_the_links_holds_longer(clock: AwakeClock, hands: Hands) -> None:
    permit = MotionGate(awake=clock).permit("move")
    hands.now += (LEASE_MS / 1000) * 3 / 4  # Zenoh keeps a link alive four times in a lease
    held = 0.0
    while permit.held:
        hands.now += BEAT_S
        held += BEAT_S
    assert held == pytest.approx(LONG_HOLD_S)


def test_motion_that_writes_once_a_second_is_not_held_while_the_thread_looks(clock: AwakeClock, hands: Hands) -> None:
    gate = MotionGate(awake=clock)
    for _ in range(50):
        for _ in range(10):
            hands.now += 0.1
            clock.look()
        assert not gate.held
    assert clock.pauses == 0


def test_motion_that_looks_shows_that_the_process_runs_though_the_thread_does_not(
    clock: AwakeClock, hands: Hands
) -> None:
    gate = MotionGate(awake=clock)
    for _ in range(100):
        hands.now += PAUSE_S - 0.01
        assert not gate.held
    assert clock.pauses == 0


def test_clock_that_nothing_watches_holds_nothing(hands: Hands) -> None:
    clock = AwakeClock(hands)
    gate = MotionGate(awake=clock)
    for _ in range(3):
        hands.now += 10.0
        assert not gate.held
    end = clock.watch(lambda: None)
    end()
    hands.now += 10.0
    assert not gate.held


def test_look_that_meets_the_end_of_the_last_watcher_holds_nothing_afterwards(
    hands: Hands, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BEAT_S", 3600.0)
    clock = AwakeClock(hands)
    ends = [clock.watch(lambda: None)]

    def end_before_the_mark(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code is not AwakeClock.look.__code__:
            return None
        if (
            event == "line"
            and ends
            and linecache.getline(module.__file__, frame.f_lineno).strip() == "self._last = now"
        ):
            ends.pop()()
        return end_before_the_mark

    hands.now += 0.1
    tracing = sys.gettrace()
    sys.settrace(end_before_the_mark)
    try:
        clock.look()
    finally:
        sys.settrace(tracing)
    assert not ends
    for _ in range(5):
        hands.now += 10.0
        assert clock.look() >= clock.held_until
    assert clock.pauses == 0
    end = clock.watch(lambda: None)
    assert clock.look() >= clock.held_until
    end()


def test_stale_look_of_a_thread_that_was_held_up_makes_no_second_pause(clock: AwakeClock, hands: Hands) -> None:
    hands.now += 0.4
    late = hands.now - 0.3
    clock.look()
    now, hands.now = hands.now, late
    clock.look()
    hands.now = now + 0.3
    clock.look()
    assert clock.pauses == 0


def test_each_watcher_is_called_after_a_pause_on_the_clocks_own_thread(hands: Hands) -> None:
    clock, threads = AwakeClock(hands), list[str]()

    def fail() -> None:
        raise RuntimeError("a watcher that fails")

    ends = [clock.watch(fail), clock.watch(lambda: threads.append(threading.current_thread().name))]
    time.sleep(0)
    hands.now += 5.0
    # A motion sees the pause first; the watchers are called all the same.
    assert MotionGate(awake=clock).held
    eventually(lambda: threads, what="the watcher")
    assert threads == ["awake-clock"]
    for end in ends:
        end()


def test_without_a_thread_to_be_had_nothing_is_held(
    hands: Hands, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def none_left(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    clock = AwakeClock(hands)
    monkeypatch.setattr(threading.Thread, "start", none_left)
    clock.watch(lambda: None)
    monkeypatch.undo()
    hands.now += 10.0
    assert not MotionGate(awake=clock).held
    assert "No thread notices" in caplog.text


def test_the_clock_goes_on_while_the_machine_sleeps() -> None:
    # CLOCK_MONOTONIC stands still in a suspended machine, CLOCK_BOOTTIME does not; neither stops with a process.
    assert abs(uptime() - time.clock_gettime(time.CLOCK_BOOTTIME)) < 60.0
