"""Turns of the interpreter while stops may come or go."""

from __future__ import annotations

import gc
import sys
from collections.abc import Collection, Iterator

import pytest

from strands_robots.safety import controller as controller_module
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.process import SWITCH_S, LongTimeSlices, PausedCollector, ShortTimeSlices
from strands_robots.safety.stop_link import OnEvent, OnState


@pytest.fixture(autouse=True)
def interval_of_python() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.005)
    yield
    sys.setswitchinterval(before)


class NoLink:
    """A link that is down."""

    up = False

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None: ...

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        return False

    def close(self) -> None: ...


def test_turns_are_short_until_the_last_of_their_users_has_ended() -> None:
    turns = ShortTimeSlices()
    first, second = turns.begin(), turns.begin()
    first()
    first()
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
    second()
    assert sys.getswitchinterval() == pytest.approx(0.005)


def test_turns_that_are_shorter_already_stay() -> None:
    sys.setswitchinterval(0.0001)
    end = ShortTimeSlices().begin()
    assert sys.getswitchinterval() == pytest.approx(0.0001, rel=0.05)
    end()
    assert sys.getswitchinterval() == pytest.approx(0.0001, rel=0.05)


def test_open_safety_controller_has_short_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever ran before in this process may have shortened its turns already.
    monkeypatch.setattr(controller_module, "shorten_time_slices", ShortTimeSlices().begin)
    controller = SafetyController("safety-1", NoLink)
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
    controller.close()
    controller.close()
    assert sys.getswitchinterval() == pytest.approx(0.005)


def test_turns_have_their_own_length_during_a_stop_of_many_and_are_short_again_after_it() -> None:
    short = ShortTimeSlices()
    end_short, end_long = short.begin(), LongTimeSlices(short).begin()
    assert sys.getswitchinterval() == pytest.approx(0.005)
    end_long()
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
    end_short()
    assert sys.getswitchinterval() == pytest.approx(0.005)


def test_turns_whose_last_user_left_during_a_stop_of_many_stay_as_they_were() -> None:
    short = ShortTimeSlices()
    end_short, end_long = short.begin(), LongTimeSlices(short).begin()
    end_short()
    end_long()
    assert sys.getswitchinterval() == pytest.approx(0.005)


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_is_paused_until_the_last_of_its_users_has_ended(enabled: bool) -> None:
    before = gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        collector = PausedCollector()
        first, second = collector.begin(), collector.begin()
        first()
        first()
        assert not gc.isenabled()
        second()
        assert gc.isenabled() is enabled
    finally:
        (gc.enable if before else gc.disable)()
