"""Joints that a stop cannot hold where they are, as a foreign driver shows.

A stop without a ``hold()`` of the device sends each joint its own position. That freezes nothing where the device does
not say where a joint is, and moves a joint whose targets are turned or scaled against its positions. Drivers of both
kinds are on the package index.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping

logger = logging.getLogger(__name__)

TOLERANCE = 0.1
"""Share of a target by which a driver may round or clamp it."""


class HoldCheck:
    """Record of what a device was told, and took, since it was held.

    Args:
        name: of the robot, for the log.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._told: set[str] = set()
        self._other: dict[str, str] = {}

    def note(self, action: Mapping[str, float], taken: Mapping[str, float], present: Mapping[str, float]) -> None:
        """Note an action, what the device says it took, and where its joints were."""
        self._told.update(action)
        for key, target in action.items():
            took, at = taken.get(key), present.get(key)
            if took is None or at is None or key in self._other:
                continue
            # A driver that bounds a step takes something between the position and the target.
            room = TOLERANCE * max(abs(target), abs(at), 1.0)
            if not min(target, at) - room <= took <= max(target, at) + room:
                self._other[key] = f"it was at {at:g}, was told {target:g} and took {took:g}"
                logger.warning("%s takes other targets than it is told: %s, %s.", self._name, key, self._other[key])

    def held(self) -> None:
        """Note that it was held."""
        self._told.clear()

    @property
    def turned(self) -> Collection[str]:
        """Keys whose targets are not told as their positions are."""
        return self._other.keys()

    def problem(self, present: Mapping[str, float], *, moving: Collection[str]) -> str:
        """Return why joints of ``moving`` that were told a target cannot be held, or ""."""
        told = sorted(self._told.intersection(moving))
        other = [f"{key} ({self._other[key]})" for key in told if key in self._other]
        unread = [key for key in told if key not in present and key not in self._other]
        reasons = []
        if other:
            reasons.append(f"its targets are not told as its positions are: {', '.join(other)}")
        if unread:
            reasons.append(f"it does not say where {', '.join(unread)} is")
        return f"{'; '.join(reasons)}; only a hold() of its own can hold it" if reasons else ""
