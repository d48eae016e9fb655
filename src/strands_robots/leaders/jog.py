"""Targets that are pushed along: what a key or a stick does to a joint, from where the joint stands."""

from __future__ import annotations

import math
from collections.abc import Mapping

from strands_robots.policies.base import Action, Ranges
from strands_robots.utils import ValidationError

SHARE_PER_S = 0.25
"""Part of a joint's whole range that a key held down, or a stick pushed to its end, crosses in a second."""

UNBOUNDED_PER_S = 45.0
"""The same for a joint without a range, in its unit a second."""


class Jog:
    """The targets of some joints, each moved by itself and kept inside its range.

    Args:
        start: where they stand, by action key, in the follower's units.
        ranges: lowest and highest target by action key; what is not named is unbounded.
    """

    def __init__(self, start: Mapping[str, float], ranges: Ranges) -> None:
        if not start:
            raise ValidationError("start must hold at least one joint to lead.")
        self.keys = tuple(start)
        self._targets = dict(start)
        self._ranges = {key: ranges.get(key, (-math.inf, math.inf)) for key in start}

    @property
    def targets(self) -> Action:
        """Every target as it is now."""
        return dict(self._targets)

    def move(self, key: str, push: float, seconds: float) -> None:
        """Push a joint for so long; ``push`` is -1 to 1."""
        low, high = self._ranges[key]
        speed = (high - low) * SHARE_PER_S if math.isfinite(high - low) else UNBOUNDED_PER_S
        self._targets[key] = min(max(self._targets[key] + push * speed * seconds, low), high)
