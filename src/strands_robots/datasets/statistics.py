"""Statistics of a dataset, by feature, as LeRobot's loaders read them.

The quantiles of several episodes are the means of theirs by their counts, as LeRobot aggregates them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Statistics = dict[str, NDArray[Any]]
"""``min max mean std count`` and the quantiles of one feature."""

SIDE = 150
"""Shorter side of a picture, in pixels, from whose double on pixels are left out."""

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def of_column(values: NDArray[Any]) -> Statistics:
    """Return the statistics of a column of ``(n, width)`` numbers."""
    rows = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    found = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    shares = np.quantile(rows, list(QUANTILES.values()), axis=0)
    return {**found, "count": np.array([len(rows)], dtype=np.int64), **dict(zip(QUANTILES, shares, strict=True))}


class PictureStatistics:
    """Statistics of RGB pictures by channel, in 0..1, gathered picture by picture.

    A histogram of 256 steps has all that is asked for. Of a large picture, each n-th pixel counts.
    """

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), dtype=np.int64)
        self._seen = 0

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add a picture of ``(height, width, 3)``."""
        step = max(1, min(picture.shape[:2]) // SIDE)
        for channel in range(3):
            self._counts[channel] += np.bincount(picture[::step, ::step, channel].ravel(), minlength=256)
        self._seen += 1

    def result(self) -> Statistics:
        """Return them in the shape ``(3, 1, 1)``; the count is that of the pictures."""
        counts, steps = self._counts, np.arange(256) / 255
        total = counts.sum(axis=1, keepdims=True).clip(1)
        mean = (counts * steps).sum(axis=1, keepdims=True) / total
        present, reached = counts > 0, counts.cumsum(axis=1) / total
        found = {
            "min": steps[present.argmax(axis=1)],
            "max": steps[255 - present[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt((counts * (steps - mean) ** 2).sum(axis=1, keepdims=True) / total),
            **{name: steps[(reached >= share).argmax(axis=1)] for name, share in QUANTILES.items()},
        }
        shaped = {name: np.asarray(value, dtype=np.float64).reshape(3, 1, 1) for name, value in found.items()}
        return {**shaped, "count": np.array([self._seen], dtype=np.int64)}


def aggregated(parts: Iterable[Statistics]) -> Statistics:
    """Return the statistics of several episodes from those of each."""
    each = list(parts)
    weights = np.array([float(part["count"][0]) for part in each])
    shape = (-1, *(1,) * each[0]["mean"].ndim)
    share = weights.reshape(shape) / max(weights.sum(), 1.0)

    def weighted(name: str) -> NDArray[Any]:
        return np.asarray((np.stack([part[name] for part in each]) * share).sum(axis=0))

    mean = weighted("mean")
    spread = np.stack([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in each])
    return {
        "min": np.stack([part["min"] for part in each]).min(axis=0),
        "max": np.stack([part["max"] for part in each]).max(axis=0),
        "mean": mean,
        "std": np.sqrt((spread * share).sum(axis=0)),
        "count": np.array([int(weights.sum())], dtype=np.int64),
        **{name: weighted(name) for name in QUANTILES},
    }


def as_json(statistics: Mapping[str, Statistics]) -> dict[str, Any]:
    """Return the content of ``stats.json``."""
    return {key: {name: value.tolist() for name, value in each.items()} for key, each in statistics.items()}
