"""Objects that are seen before and after a motion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from strands_robots.kinematics.chain import Floats
from strands_robots.kinematics.objects import Held, SeenObject
from strands_robots.utils import ValidationError

PLACED_MM = 15.0
"""An object that was put down further from its place was not put there."""

CARRIED_MM = 40.0
"""An object further from where the jaws have it was not picked up."""

PUSHED_MM = 5.0
"""Horizontal distance from which an object counts as moved."""

FELL_MM = 20.0
"""Vertical distance from which it does; one that was added in the air settles by less."""

GIVEN_NEAR_M = 0.025
"""Greatest distance of an object from the place that a caller gave for it."""

_RESTS_M = 0.01
"""Greatest gap between an object and what it stands on."""


@dataclass
class Sight:
    """Objects around one motion.

    Attributes:
        before: the objects at its start.
        name: of the object that it picks up or puts down; empty for none.
        wanted: where the centre of that object shall be in the end (m), None where that is not known.
        within_mm: greatest distance from there.
        after: the objects at its end; None until then, and where they could not be seen.
    """

    before: Sequence[SeenObject]
    name: str = ""
    wanted: Floats | None = None
    within_mm: float = PLACED_MM
    after: Sequence[SeenObject] | None = field(default=None, init=False)

    @property
    def moved(self) -> dict[str, int] | None:
        """Millimetres by which other objects were moved; None where that is not known."""
        if self.after is None:
            return None
        now = {each.name: each.position for each in self.after}
        found = {}
        for each in self.before:
            if each.name == self.name or each.name not in now:
                continue
            offset = 1000 * (now[each.name] - each.position)
            if np.hypot(offset[0], offset[1]) >= PUSHED_MM or abs(offset[2]) >= FELL_MM:
                found[each.name] = round(float(np.linalg.norm(offset)))
        return found

    def row(self) -> dict[str, Any]:
        """Return the fields of an answer that tell of objects."""
        at, error_mm = self._object_at(), self._error_mm()
        return {
            "object_at": None if at is None else {a: round(float(v), 4) for a, v in zip("xyz", at, strict=True)},
            "object_error_mm": None if error_mm is None else round(error_mm, 1),
            "moved": self.moved,
        }

    def problem(self) -> str:
        """Return why the object is not in its place; empty where it is, or is unseen."""
        error_mm = self._error_mm()
        if error_mm is None or error_mm <= self.within_mm:
            return ""
        return f"{self.name} is {error_mm:.0f} mm from where it should be"

    def remark(self) -> str:
        """Return what else the motion moved, in words; empty for nothing."""
        return ", ".join(f"{name} was moved by {distance} mm" for name, distance in (self.moved or {}).items())

    def _object_at(self) -> Floats | None:
        return next((each.position for each in self.after or () if self.name and each.name == self.name), None)

    def _error_mm(self) -> float | None:
        at = self._object_at()
        return None if at is None or self.wanted is None else 1000 * float(np.linalg.norm(at - self.wanted))


def require_uncovered(target: SeenObject, objects: Iterable[SeenObject]) -> None:
    """Refuse to pick an object up on which another one stands."""
    top = float(target.position[2] + target.size[2] / 2)
    for each in objects:
        bottom = float(each.position[2] - each.size[2] / 2)
        if each.name != target.name and abs(bottom - top) <= _RESTS_M and _over(target, each):
            raise ValidationError(f"{each.name} stands on {target.name}; pick {each.name} up first.")


def require_vacant(position: Floats, held: Held, objects: Iterable[SeenObject], on: str = "") -> None:
    """Refuse to put the held object down where another one is.

    Args:
        position: of its bottom (m).
        held: what is put down.
        objects: those that are seen.
        on: the object on which it is put.
    """
    low, high = float(position[2]) + _RESTS_M, float(position[2]) + 2 * held.below
    for each in objects:
        if each.name in (held.name, on):
            continue
        bottom, top = (float(each.position[2] + sign * each.size[2] / 2) for sign in (-1, 1))
        apart = float(np.hypot(*(each.position - position)[:2]))
        if bottom < high and top > min(low, high - 1e-3) and apart < _inner(each.size) + held.radius:
            raise ValidationError(
                f"{each.name} is at that place; put {held.name or 'it'} elsewhere, or on it by on={each.name}."
            )


def nearest(position: Floats, objects: Iterable[SeenObject]) -> str:
    """Return the name of the object at a place that a caller gave; empty for none."""
    near = [(float(np.linalg.norm(each.position - position)), each.name) for each in objects]
    distance, name = min(near, default=(np.inf, ""))
    return name if distance <= GIVEN_NEAR_M else ""


def _over(lower: SeenObject, upper: SeenObject) -> bool:
    apart = float(np.hypot(*(upper.position - lower.position)[:2]))
    return apart < _inner(lower.size) + _inner(upper.size)


def _inner(size: Floats) -> float:
    """Return the radius of the circle within an object's outline."""
    return float(min(size[0], size[1])) / 2
