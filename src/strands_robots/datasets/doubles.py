"""Pictures that are there twice: of two cameras, or of two episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

EVERY, SAMPLES_MAX = 5, 64
"""A picture of so many is looked at, and so many of an episode at most."""

CELLS = 16
"""Rows and columns of cells that a picture is told by."""

SAME_LEVELS = 3.0
"""Most levels, of 256, by which a cell of the same picture differs: what an encoder adds."""

DIFFER_SHARE = 0.05
"""Part of a joint's range by which states differ."""


@dataclass(frozen=True, slots=True)
class Look:
    """Pictures of one camera in one episode, each as the means of its cells.

    Args:
        cells: of each picture that is looked at, ``(n, rows, columns)``.
    """

    cells: NDArray[np.float32]

    @property
    def changes(self) -> bool:
        """True where its pictures are not all the same."""
        return bool(len(self.cells)) and float(np.abs(self.cells - self.cells[0]).max()) > SAME_LEVELS

    def same_as(self, other: Look) -> bool:
        """Return True where the pictures at the same frames are the same."""
        count = min(len(self.cells), len(other.cells))
        mine, its = self.cells[:count], other.cells[:count]
        return count > 0 and mine.shape == its.shape and float(np.abs(mine - its).max()) <= SAME_LEVELS


def cells_of(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the mean brightness of each cell of a picture."""
    height, width = (max(1, side // CELLS) for side in picture.shape[:2])
    rows, columns = picture.shape[0] // height, picture.shape[1] // width
    whole = picture[: rows * height, : columns * width].reshape(rows, height, columns, width, -1)
    return np.asarray(whole.mean(axis=(1, 3, 4)), dtype=np.float32)


@dataclass
class Doubles:
    """Search for pictures that are there twice, episode by episode."""

    _looks: dict[str, list[tuple[int, Look]]] = field(default_factory=dict)
    _states: dict[int, NDArray[np.float64]] = field(default_factory=dict)

    def add(self, episode: int, looks: Mapping[str, Look], state: NDArray[np.float64]) -> Iterator[tuple[str, bool]]:
        """Take an episode; yield what is said of it, and whether that is wrong.

        Args:
            episode: its index.
            looks: by camera.
            state: of all its frames, ``(n, joints)``.
        """
        self._states[episode] = state[: EVERY * SAMPLES_MAX]
        for (one, first), (other, second) in combinations(looks.items(), 2):
            if first.same_as(second):
                yield f"{one} and {other} have the same pictures", first.changes or _differ(state, state[:1])
        for name, look in looks.items():
            earlier = self._looks.setdefault(name, [])
            double = next((number for number, each in earlier if each.same_as(look)), None)
            if double is not None:
                moved = self._differ_from(double, episode)
                states = "other states" if moved else "the same states"
                yield f"{name} has the pictures of episode {double}, with {states}", moved and look.changes
            earlier.append((episode, look))

    def _differ_from(self, one: int, other: int) -> bool:
        first, second = self._states[one], self._states[other]
        count = min(len(first), len(second))
        return first.shape[1:] != second.shape[1:] or _differ(first[:count], second[:count])


def _differ(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return True where a joint differs by more than a part of what it goes in both."""
    if not len(one) or not len(other):
        return False
    reach = np.ptp(np.concatenate([one, other]), axis=0)
    return bool((np.abs(one - other).max(axis=0) > np.maximum(DIFFER_SHARE * reach, 1e-6)).any())
