"""Wilson's interval, against values of its formula worked out by hand."""

from __future__ import annotations

import pytest

from strands_robots.evaluation import wilson


@pytest.mark.parametrize(
    ("successes", "episodes", "low", "high"),
    [(0, 0, 0.0, 1.0), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662)],
)
def test_the_interval_is_that_of_the_formula(successes: int, episodes: int, low: float, high: float) -> None:
    assert wilson(successes, episodes) == pytest.approx((low, high), abs=1e-4)
