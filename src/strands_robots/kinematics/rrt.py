"""A joint path around contacts by RRT-Connect, two trees that grow together.

Deterministic: the points come from a fixed sequence, and the number of tries is bounded. The caller bounds the time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from strands_robots.kinematics.chain import Floats

TRIES_MAX = 2000
"""Most points towards which the trees grow."""

STEP = 0.2
"""Length of a branch by its largest joint (rad or m)."""

SHORTCUTS = 60

Clear = Callable[[Floats, Floats], bool]
"""True where the straight way between two poses is free of contact."""


class _Tree:
    """Poses, and the one from which each was reached."""

    def __init__(self, root: Floats) -> None:
        self.points = root[None, :].copy()
        self.parents = [-1]

    def grow(self, towards: Floats, clear: Clear) -> tuple[int, bool]:
        """Take one step towards a pose.

        Returns:
            The new point and True, or the nearest and False where a contact is between.
        """
        index = int(np.argmin(np.abs(self.points - towards).max(axis=1)))
        near = self.points[index]
        offset = towards - near
        length = float(np.abs(offset).max())
        if length < 1e-9:
            return index, True
        point = near + offset * min(1.0, STEP / length)
        if not clear(near, point):
            return index, False
        self.points = np.concatenate([self.points, point[None, :]])
        self.parents.append(index)
        return len(self.parents) - 1, True

    def way(self, index: int) -> list[Floats]:
        """Return the poses from the root to a point."""
        found = []
        while index >= 0:
            found.append(self.points[index])
            index = self.parents[index]
        return found[::-1]


def path_around(
    start: Floats, goal: Floats, limits: tuple[Floats, Floats], clear: Clear, going: Callable[[], bool]
) -> list[Floats] | None:
    """Return poses from ``start`` to ``goal`` with free straight ways between them.

    Args:
        start: joints (rad or m), free of contact.
        goal: joints, free of contact.
        limits: least and greatest value of each joint.
        clear: the check of a straight way.
        going: asked before each step; false ends the search.

    Returns:
        The poses, or None where no way was found within the bounds.
    """
    draw = np.random.default_rng(0)
    lows, highs = limits
    trees = [_Tree(start), _Tree(goal)]
    for turn in range(TRIES_MAX):
        if not going():
            return None
        grown, other = trees[turn % 2], trees[(turn + 1) % 2]
        index, took = grown.grow(lows + (highs - lows) * draw.random(len(lows)), clear)
        if not took:
            continue
        target, meets = grown.points[index], False
        while True:
            reached, took = other.grow(target, clear)
            meets = took and bool(np.abs(other.points[reached] - target).max() < 1e-9)
            if meets or not took or not going():
                break
        if meets:
            first, second = grown.way(index), other.way(reached)
            way = first + second[-2::-1]
            return _shortened(way if turn % 2 == 0 else way[::-1], clear, draw, going)
    return None


def _shortened(way: list[Floats], clear: Clear, draw: np.random.Generator, going: Callable[[], bool]) -> list[Floats]:
    """Leave out poses that a free straight way passes by."""
    for _ in range(SHORTCUTS):
        if len(way) < 3 or not going():
            break
        first, last = sorted(int(each) for each in draw.choice(len(way), 2, replace=False))
        if last - first > 1 and clear(way[first], way[last]):
            del way[first + 1 : last]
    index = 0
    while index + 2 < len(way) and going():
        if clear(way[index], way[index + 2]):
            del way[index + 1]
        else:
            index += 1
    return way
