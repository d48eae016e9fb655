"""Ages of commands by two clocks that were never set."""

from __future__ import annotations

import random

import pytest

from strands_robots.policies.freshness import MEASURED_S, SPARE_S, CommandAges

SET_APART = 1234.5
"""What the leader's clock is behind the robot's."""


class Link:
    """Commands of one leader over a link, and their ages as the robot knows them."""

    def __init__(self, way_s: float, back_s: float | None = None) -> None:
        self.ages = CommandAges()
        self.way_s, self.back_s = way_s, way_s if back_s is None else back_s
        self.answers = [(-self.back_s, 0.0)]
        """What the robot told of its clock, and when that came."""

    def send(self, made: float, late_s: float = 0.0) -> float:
        """Return the age of a command that is made at a moment of the robot's clock."""
        received = made + self.way_s + late_s
        told, at = max(each for each in self.answers if each[1] <= made)
        self.answers = [each for each in self.answers if each[1] >= at] + [(received, received + self.back_s)]
        return self.ages.age_s(made - SET_APART, received, told, made - at)


def test_age_is_the_way_of_the_link_and_what_came_on_top() -> None:
    link = Link(0.075)
    ages = [link.send(number / 50) for number in range(100)]
    assert ages[-1] == pytest.approx(0.075, abs=1e-6)
    assert link.ages.limit_s == pytest.approx(0.175, abs=1e-6)
    assert link.send(3.0, late_s=0.05) == pytest.approx(0.125, abs=1e-6)
    assert link.send(3.1, late_s=0.2) > link.ages.limit_s


def test_steady_link_with_jitter_has_no_stale_command_in_ten_minutes() -> None:
    link, draw = Link(0.07), random.Random(3).uniform
    late = [link.send(number / 50, draw(0.0, 0.01)) > link.ages.limit_s for number in range(30_000)]
    measured = int(MEASURED_S * 50) + 2
    assert not any(late[measured:])
    assert any(late[:measured]), "a round trip this long proves nothing before"


def test_first_commands_of_a_link_that_queued_them_are_stale() -> None:
    link = Link(0.0)
    queued = [link.send(number / 50, 0.5 - number / 50) > link.ages.limit_s for number in range(26)]
    young = int(SPARE_S * 50) + 1
    assert all(queued[:-young])
    assert not any(queued[-young + 1 :])


def test_what_queued_while_the_robots_computer_slept_is_stale_and_the_link_is_measured_anew() -> None:
    link = Link(0.025)
    for number in range(200):
        link.send(number / 50)
    slept_s = 5.0
    queued = [link.send(4.0 + number / 50, -slept_s) > link.ages.limit_s for number in range(10)]
    assert all(queued), "its clock stood still, so they seem to come before they were made"
    link.way_s, link.back_s = link.way_s - slept_s, link.back_s + slept_s
    link.answers = [(-0.9, 4.125)]
    later = [link.send(4.2 + number / 50) > link.ages.limit_s for number in range(20)]
    assert not any(later)


@pytest.mark.parametrize("outage_s", [0.5, 3.0, 60.0])
def test_what_queued_in_an_outage_is_stale_however_long_it_was(outage_s: float) -> None:
    link = Link(0.025)
    for number in range(200):
        link.send(number / 50)
    began = 4.0
    queued = [began + number / 50 for number in range(int(outage_s * 50))]
    ages = [link.send(made, began + outage_s - made) for made in queued]
    fresh = [age for age in ages if age <= link.ages.limit_s]
    assert len(fresh) <= (SPARE_S + link.way_s) * 50 + 1, "only the last ones are as young as the link is"
    assert link.send(began + outage_s + 0.1) <= link.ages.limit_s, "the next one is fresh"


def test_link_that_is_slower_from_now_on_is_measured_anew_after_ten_seconds() -> None:
    link = Link(0.01)
    for number in range(100):
        link.send(number / 50)
    link.way_s = 0.2
    ages = [link.send(2.0 + number / 50) > link.ages.limit_s for number in range(1000)]
    assert all(ages[:400])
    assert not any(ages[-200:])


def test_link_that_is_too_slow_to_lead_over_never_has_a_fresh_command() -> None:
    link = Link(0.4)
    assert all(link.send(number / 50) > link.ages.limit_s for number in range(1, 1000))
