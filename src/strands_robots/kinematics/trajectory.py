"""Joint trajectories from rest to rest within bounds of each joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from strands_robots.utils import DURATION_MAX_S, ValidationError

if TYPE_CHECKING:  # MuJoCo is not needed to time a path of joints
    from strands_robots.kinematics.chain import Floats

_GRID = 400
"""Points of a trajectory; between them it is straight."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Greatest speed (rad/s or m/s) and acceleration of each joint."""

    speed: Floats
    acceleration: Floats

    def scaled(self, share: float) -> Bounds:
        """Return the bounds of a motion at a share of full speed."""
        return Bounds(self.speed * share, self.acceleration * share)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Joint positions (n, joints) at times (n) in seconds from 0."""

    times: Floats
    points: Floats

    @property
    def duration(self) -> float:
        """Seconds from the start to the end."""
        return float(self.times[-1])

    def at(self, seconds: float) -> Floats:
        """Return the positions at a time; before the start and after the end those of it."""
        return np.array([np.interp(seconds, self.times, column) for column in self.points.T])

    def sampled(self, hz: float) -> Floats:
        """Return the setpoints of each control step after the first, the end included.

        Raises:
            ValidationError: the motion is so slow that it would last longer than an hour.
        """
        if not self.duration <= DURATION_MAX_S:  # also where it cannot be computed
            raise ValidationError(
                f"speed must let the motion end within {DURATION_MAX_S:g} s, not in {self.duration:.3g} s."
            )
        steps = int(np.ceil(self.duration * hz - 1e-9))
        return np.array([self.at((index + 1) / hz) for index in range(steps)]).reshape(steps, self.points.shape[1])


def timed(path: Floats, bounds: Bounds) -> Trajectory:
    """Time a path of joint positions (n, joints) by a minimum-jerk profile.

    The path is a straight line between two points, else a smooth curve through all.
    """
    steps = np.abs(np.diff(path, axis=0)) / bounds.speed
    lengths = np.concatenate([[0.0], np.cumsum(steps.max(axis=1))])
    keep = np.concatenate([[True], np.diff(lengths) > 1e-9])
    lengths, path = lengths[keep], path[keep]
    if len(path) < 2:
        return Trajectory(np.zeros(1), path[:1])
    share = np.linspace(0.0, 1.0, _GRID)
    travelled = share**3 * (share * (6 * share - 15) + 10) * lengths[-1]
    points = _curve(lengths, path, travelled)
    step = share[1]
    velocity = np.abs(np.diff(points, axis=0)) / step
    acceleration = np.abs(np.diff(points, n=2, axis=0)) / step**2
    seconds = max(float((velocity / bounds.speed).max()), float(np.sqrt((acceleration / bounds.acceleration).max())))
    return Trajectory(share * seconds, points)


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return trajectories one after another; each starts where the one before ends."""
    ends = np.concatenate([[0.0], np.cumsum([part.duration for part in parts])])
    times = np.concatenate([part.times + end for part, end in zip(parts, ends[:-1], strict=True)])
    return Trajectory(times, np.concatenate([part.points for part in parts]))


def _curve(lengths: Floats, path: Floats, at: Floats) -> Floats:
    """Return the cubic spline through ``path``, a line for two points."""
    if len(path) == 2:
        straight: Floats = path[0] + (at / lengths[-1])[:, None] * (path[1] - path[0])
        return straight
    gaps = np.diff(lengths)
    slopes = np.diff(path, axis=0) / gaps[:, None]
    count = len(path)
    system, right = np.eye(count), np.zeros_like(path)
    for i in range(1, count - 1):
        system[i, i - 1 : i + 2] = gaps[i - 1], 2 * (gaps[i - 1] + gaps[i]), gaps[i]
        right[i] = 6 * (slopes[i] - slopes[i - 1])
    bends = np.linalg.solve(system, right)
    index = np.clip(np.searchsorted(lengths, at, side="right") - 1, 0, count - 2)
    into = (at - lengths[index])[:, None]
    gap = gaps[index][:, None]
    first = slopes[index] - gap * (2 * bends[index] + bends[index + 1]) / 6
    result: Floats = path[index] + into * (
        first + into * (bends[index] / 2 + into * (bends[index + 1] - bends[index]) / (6 * gap))
    )
    return result
