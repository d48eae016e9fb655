"""Arithmetic of the table of takeovers: what is a miss, and that its wire would see a stale command."""

from __future__ import annotations

import pytest
from benchmarks.takeover import (
    STATES,
    STEP_MAX,
    back_row,
    kill_row,
    picture_row,
    stop_row,
    takeover_row,
    wire_row,
)
from benchmarks.takeover_lerobot import FPS, Loop, age_s, loop_row
from benchmarks.takeover_wire import Carried, Weather, Wire

from strands_robots.policies.freshness import CommandAges

WHY = {"the newest picture of hand"}


def test_takeovers_are_bounded_in_time_and_jump() -> None:
    assert takeover_row([0.03] * 100, [STEP_MAX], 0).ok
    assert not takeover_row([0.03] * 98 + [0.05] * 2, [0.0], 0).ok
    assert not takeover_row([0.03] * 100, [STEP_MAX + 0.1], 0).ok


def test_giving_back_loses_no_frame() -> None:
    assert back_row([0.03] * 100, 500, 500).ok
    assert not back_row([0.03] * 100, 500, 499).ok
    assert not back_row([0.05] * 100, 500, 500).ok


def test_one_stale_command_or_false_hold_is_a_miss() -> None:
    good, steady = Carried(sent=10, carried=5), Carried(sent=10, carried=10)
    assert wire_row(0.025, [good], steady).ok
    assert not wire_row(0.025, [good, Carried(sent=10, carried=5, stale=1)], steady).ok
    assert not wire_row(0.025, [good], Carried(sent=10, carried=10, holds=1)).ok
    assert not wire_row(0.025, [Carried(sent=10)], steady).ok, "nothing was carried out"


def test_wire_carries_out_no_stale_command_and_would_tell_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    weather = Weather(0.025, loss=0.05)
    found = Wire(weather).run(2000)
    assert found.stale == 0
    assert found.carried > 500
    assert found.dropped > 100
    monkeypatch.setattr(CommandAges, "limit_s", 10.0)
    assert Wire(weather).run(2000).stale > 0


def test_pictures_kills_and_stops_have_their_bounds() -> None:
    assert picture_row({"freezes": [350.0], "lags": [340.0]}, WHY).ok
    assert not picture_row({"freezes": [351.0], "lags": [340.0]}, WHY).ok
    assert not picture_row({"freezes": [10.0]}, {"no fresh command"}).ok, "it held for another reason"
    assert kill_row("the leader", [300.0]).ok
    assert not kill_row("the leader", [10.0] * 99 + [301.0]).ok
    good = dict.fromkeys(STATES, [5.0] * 100)
    assert stop_row(good).ok
    assert not stop_row({**good, "held": [5.0] * 98 + [21.0] * 2}).ok


def test_loop_of_lerobot_has_a_rate_and_is_compared_by_its_slow_beats() -> None:
    even = [n / 29.8 for n in range(200)]
    theirs = Loop([even, even], [0.02])
    assert loop_row(Loop([even, even], [0.04]), theirs, 6.7).ok
    assert not loop_row(Loop([[n / 29.4 for n in range(200)]] * 2, [0.04]), theirs, 6.7).ok, "too slow"
    late = [at + (0.012 if n % 50 == 0 else 0.0) for n, at in enumerate(even)]
    assert not loop_row(Loop([late, late], [0.04]), theirs, 6.7).ok, "one beat of fifty is late"


def test_turns_of_a_loop_are_not_one() -> None:
    assert Loop([[0.0, 0.1], [5.0, 5.1]]).rate == pytest.approx(10)


def test_age_of_a_picture_is_known_by_its_number() -> None:
    number = int(1000.0 * FPS)
    assert age_s(number % 2**16, 1000.05) == pytest.approx(0.05)
    assert age_s(2**16 - 1, 2**16 / FPS) == pytest.approx(1 / FPS), "the numbers begin anew"


def test_pictures_that_the_encoder_dropped_have_no_age() -> None:
    loop = Loop([[0.0, 0.1]])
    loop.see([0, 2], [0.0, 0.1])
    assert loop.ages == [0.0, pytest.approx(0.1 - 2 / FPS)]
    loop.see([2], [0.0, 0.1])
    assert (len(loop.ages), loop.dropped) == (2, 1)
