"""Success rates with their confidence intervals."""

from __future__ import annotations

import math

Z95 = 1.959964
"""Quantile of the normal distribution for 95 %."""


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """Return Wilson's score interval (95 %) of a success rate, from 0 to 1."""
    if episodes == 0:
        return 0.0, 1.0
    share, square = successes / episodes, Z95**2
    centre = (share + square / (2 * episodes)) / (1 + square / episodes)
    spread = Z95 * math.sqrt(share * (1 - share) / episodes + square / (4 * episodes**2)) / (1 + square / episodes)
    # At the ends rounding may leave the interval by 1e-17.
    low, high = max(0.0, centre - spread), min(1.0, centre + spread)
    return (0.0 if successes == 0 else low), (1.0 if successes == episodes else high)
