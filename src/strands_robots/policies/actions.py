"""Is this action usable? The one check of what policies and leaders ask of a robot, and the bound of its speed."""

from __future__ import annotations

import math
from collections.abc import Mapping

from strands_robots.policies.base import Action, Ranges
from strands_robots.utils import ValidationError, mapping, number, shown


def checked_action(action: object, ranges: Ranges) -> Action:
    """``action`` with every value clamped to the range of its key.

    Raises:
        ValidationError: no object, a key the robot has not, or a value that is no finite number.
    """
    checked: Action = {}
    for key, value in mapping("action", action).items():
        if key not in ranges:
            raise ValidationError(f"action has no key {shown(key)}; the robot has {', '.join(ranges)}.")
        low, high = ranges[key]
        checked[key] = min(max(number(f"action[{key!r}]", _plain(value)), low), high)
    return checked


def numbers(observation: Mapping[str, object]) -> dict[str, float]:
    """The finite numbers of an observation: no images, no flags, no text."""
    found: dict[str, float] = {}
    for key, value in observation.items():
        scalar = _plain(value)
        if isinstance(scalar, int | float) and not isinstance(scalar, bool) and math.isfinite(scalar):
            found[key] = float(scalar)
    return found


def _plain(value: object) -> object:
    """The Python number behind a scalar of an array package; anything else as it is."""
    item = getattr(value, "item", None)
    return item() if callable(item) and getattr(value, "ndim", None) == 0 else value


class SpeedLimit:
    """Bounds how fast each target may change, in units a second of its key.

    Args:
        ranges: a key with a finite range may cross it ``full_ranges_per_s`` times a second.
        full_ranges_per_s: above 0.
        unbounded_per_s: bound of a key without a range, in its unit a second.
    """

    def __init__(self, ranges: Ranges, full_ranges_per_s: float, unbounded_per_s: float) -> None:
        self._per_s = {
            key: (high - low) * full_ranges_per_s if math.isfinite(high - low) else unbounded_per_s
            for key, (low, high) in ranges.items()
        }

    def limit(self, target: Action, last: Mapping[str, float], dt: float) -> Action:
        """``target`` no further from ``last`` than ``dt`` seconds allow. A key without a last value passes."""
        limited: Action = {}
        for key, value in target.items():
            reach = self._per_s[key] * dt
            before = last.get(key, value)
            limited[key] = min(max(value, before - reach), before + reach)
        return limited
