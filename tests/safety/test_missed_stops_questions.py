"""Times of the questions for missed stops."""

from __future__ import annotations

from itertools import pairwise

import pytest

from strands_robots.safety import missed_stops
from strands_robots.safety.missed_stops import Asker


def test_process_asks_again_after_two_seconds_and_not_more_than_once_a_second() -> None:
    asker, asked = Asker(), list[float]()
    for step in range(100):
        now = step / 10
        if step < 10:
            asker.want(now)  # a link that comes and goes
        if now >= asker.due:
            asker.settle(now, dropped=False)
            if now >= asker.due:
                asker.asked(now)
                asked.append(now)
    assert asked == [0.0, 1.0, 3.0]


def test_question_because_a_peer_is_back_waits_for_the_others_and_is_not_put_off_by_them() -> None:
    asker = Asker()
    asker.want(10.0 + missed_stops.SETTLE_S)
    asker.want(10.1 + missed_stops.SETTLE_S)
    assert asker.due == 10.0 + missed_stops.SETTLE_S


def test_question_that_may_have_gone_over_a_lost_link_is_soon_asked_again_but_not_each_time() -> None:
    asker, asked = Asker(), list[float]()
    for step in range(1200):
        now = step / 100
        asker.want(now, link_back=step > 0)  # a link that comes and goes
        if now >= asker.due:
            asker.asked(now)
            asked.append(now)
    early = [later for before, later in pairwise(asked) if later - before < missed_stops.ASK_EVERY_S - 0.02]
    assert early[0] == pytest.approx(missed_stops.SETTLE_S, abs=0.02)
    assert len(early) <= 1 + 12 / missed_stops.LOST_EVERY_S
    assert len(asked) <= 12 / missed_stops.ASK_EVERY_S + len(early) + 1


def test_process_whose_robots_are_all_locked_asks_later_and_seldom() -> None:
    asker, asked = Asker(), list[float]()
    for step in range(120):
        now = step / 10
        asker.want(now, 1.5)
        if now >= asker.due:
            asker.asked(now)
            asker.not_asked()
            asked.append(now)
    assert asked == [1.5, 6.5, 11.5]
    asker.want(12.0, 1.5)
    asker.want(12.6)  # it was resumed, and was away since
    assert asker.due == 12.6


def test_process_whose_answers_had_to_be_dropped_goes_on_asking_a_few_times() -> None:
    asker, asked = Asker(), list[float]()
    asker.want(0.0)
    for now in range(100):
        asker.settle(now, dropped=True)
        if now >= asker.due:
            asker.asked(now)
            asked.append(now)
    assert asked == [0.0, 2.0, 4.0, 6.0, 8.0]
