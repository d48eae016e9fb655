"""A way around what is in between, the same one each time, or none within the bounds."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from strands_robots.kinematics.planner import path_around

Floats = NDArray[np.float64]

LIMITS = (np.array([-2.0, -2.0]), np.array([2.0, 2.0]))
START, GOAL = np.array([-1.0, 0.0]), np.array([1.0, 0.0])


def past_a_wall(first: Floats, last: Floats) -> bool:
    """A wall of 0.4 rad with a gap above 1.2."""
    points = first + np.linspace(0, 1, 40)[:, None] * (last - first)
    return not bool(((np.abs(points[:, 0]) < 0.2) & (points[:, 1] < 1.2)).any())


def test_way_leads_around_and_each_part_of_it_is_free() -> None:
    way = path_around(START, GOAL, LIMITS, past_a_wall, lambda: True)
    assert way is not None
    assert np.array_equal(way[0], START)
    assert np.array_equal(way[-1], GOAL)
    assert all(past_a_wall(first, last) for first, last in itertools.pairwise(way))
    assert len(way) <= 8


def test_way_is_the_same_each_time() -> None:
    first, again = (path_around(START, GOAL, LIMITS, past_a_wall, lambda: True) for _ in range(2))
    assert first is not None
    assert again is not None
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_closed_wall_has_no_way_within_the_bounds() -> None:
    def closed(first: Floats, last: Floats) -> bool:
        points = first + np.linspace(0, 1, 40)[:, None] * (last - first)
        return not bool((np.abs(points[:, 0]) < 0.2).any())

    assert path_around(START, GOAL, LIMITS, closed, lambda: True) is None


def test_search_that_is_not_wanted_any_more_ends_at_once() -> None:
    asked = itertools.count()
    assert path_around(START, GOAL, LIMITS, lambda *_: False, lambda: next(asked) < 3) is None
    assert next(asked) <= 5
