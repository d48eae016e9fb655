"""Trajectories: rest to rest within the bounds, sampled for any control rate."""

from __future__ import annotations

import numpy as np
import pytest

from strands_robots.kinematics.arm import Bounds, joined, timed

BOUNDS = Bounds(np.array([1.0, 0.5]), np.array([4.0, 4.0]))
CORNERED = np.array([[0.0, 0.0], [0.3, 0.05], [0.5, 0.2], [0.55, 0.4]])


@pytest.mark.parametrize("path", [np.array([[0.0, 1.0], [0.7, 0.2]]), CORNERED], ids=["line", "curve"])
@pytest.mark.parametrize("hz", [10.0, 50.0, 333.0])
def test_every_interval_keeps_the_speed_of_each_joint(path: np.ndarray, hz: float) -> None:
    setpoints = np.vstack([path[:1], timed(path, BOUNDS).sampled(hz)])
    assert (np.abs(np.diff(setpoints, axis=0)) * hz <= BOUNDS.speed * (1 + 1e-9)).all()


@pytest.mark.parametrize("path", [np.array([[0.0, 1.0], [0.7, 0.2]]), CORNERED], ids=["line", "curve"])
def test_acceleration_is_kept_and_ends_are_at_rest(path: np.ndarray) -> None:
    trajectory = timed(path, BOUNDS)
    step = trajectory.times[1]
    bends = np.abs(np.diff(trajectory.points, n=2, axis=0)) / step**2
    assert (bends <= BOUNDS.acceleration * (1 + 1e-6)).all()
    assert trajectory.points[0] == pytest.approx(path[0])
    assert trajectory.points[-1] == pytest.approx(path[-1])
    assert np.abs(np.diff(trajectory.points, axis=0)[[0, -1]]).max() / step < 0.01


def test_curve_passes_through_every_point() -> None:
    points = timed(CORNERED, BOUNDS).points
    for wanted in CORNERED:
        assert np.abs(points - wanted).max(axis=1).min() < 5e-3


def test_half_the_speed_takes_at_least_twice_the_time_of_a_long_way() -> None:
    path = np.array([[0.0, 0.0], [3.0, 0.0]])
    assert timed(path, BOUNDS.scaled(0.5)).duration == pytest.approx(2 * timed(path, BOUNDS).duration)


def test_no_way_takes_no_time() -> None:
    assert timed(np.zeros((2, 2)), BOUNDS).duration == 0.0
    assert len(timed(np.zeros((2, 2)), BOUNDS).sampled(50)) == 0


def test_joined_parts_follow_one_another() -> None:
    first = timed(np.array([[0.0, 0.0], [0.4, 0.0]]), BOUNDS)
    second = timed(np.array([[0.4, 0.0], [0.4, 0.3]]), BOUNDS)
    both = joined([first, second])
    assert both.duration == pytest.approx(first.duration + second.duration)
    assert both.at(first.duration) == pytest.approx([0.4, 0.0])
    assert both.at(both.duration + 1) == pytest.approx([0.4, 0.3])
