"""Objects before and after a motion: what stands where, and what was moved."""

from __future__ import annotations

import numpy as np
import pytest

from strands_robots.kinematics.objects import Held, SeenObject, Sight, nearest, require_uncovered, require_vacant
from strands_robots.utils import ValidationError


def thing(name: str, x: float, y: float = 0.0, z: float = 0.0125, size: float = 0.025) -> SeenObject:
    return SeenObject(name, np.array([x, y, z]), 0.0, np.full(3, size))


HELD = Held("cube", np.zeros(3), 0.0125, 0.025, 90.0, 0.0125)


def test_other_objects_that_were_pushed_are_named_with_millimetres() -> None:
    sight = Sight([thing("cube", 0.2), thing("glass", 0.3), thing("still", 0.1)], "cube")
    assert sight.moved is None
    sight.after = [thing("cube", 0.25), thing("glass", 0.3, 0.092), thing("still", 0.103)]
    assert sight.moved == {"glass": 92}
    assert sight.remark() == "glass was moved by 92 mm"


def test_object_that_only_settles_was_not_moved_and_one_that_fell_was() -> None:
    sight = Sight([thing("settles", 0.2, z=0.02), thing("falls", 0.3, z=0.06)])
    sight.after = [thing("settles", 0.2), thing("falls", 0.3)]
    assert sight.moved == {"falls": 48}


@pytest.mark.parametrize(("off_mm", "problem"), [(14, ""), (16, "cube is 16 mm from where it should be")])
def test_object_beyond_15_mm_was_not_placed(off_mm: int, problem: str) -> None:
    sight = Sight([], "cube", np.array([0.2, 0.0, 0.0125]))
    sight.after = [thing("cube", 0.2 + off_mm / 1000)]
    assert sight.problem() == problem
    assert sight.row()["object_error_mm"] == off_mm


def test_object_that_is_not_seen_is_not_known_and_no_problem() -> None:
    sight = Sight([], "cube", np.zeros(3))
    sight.after = []
    assert (sight.problem(), sight.row()) == ("", {"object_at": None, "object_error_mm": None, "moved": {}})


def test_lower_object_of_a_stack_is_refused_by_the_upper_ones_name() -> None:
    low, high = thing("low", 0.2), thing("high", 0.205, z=0.0375)
    with pytest.raises(ValidationError, match="high stands on low; pick high up first"):
        require_uncovered(low, [low, high, thing("beside", 0.23)])
    require_uncovered(high, [low, high])


def test_occupied_place_is_refused_by_name_and_the_place_beside_it_is_not() -> None:
    with pytest.raises(ValidationError, match="other is at that place"):
        require_vacant(np.array([0.21, 0.0, 0.0]), HELD, [thing("other", 0.2), thing("cube", 0.2)])
    require_vacant(np.array([0.23, 0.0, 0.0]), HELD, [thing("other", 0.2)])
    require_vacant(np.array([0.2, 0.0, 0.025]), HELD, [thing("other", 0.2)], on="other")
    with pytest.raises(ValidationError, match="top is at that place"):
        require_vacant(np.array([0.2, 0.0, 0.025]), HELD, [thing("other", 0.2), thing("top", 0.2, z=0.0375)], "other")


def test_object_at_a_given_place_is_the_nearest_within_25_mm() -> None:
    assert nearest(np.array([0.21, 0.0, 0.0125]), [thing("a", 0.2), thing("b", 0.25)]) == "a"
    assert nearest(np.array([0.3, 0.0, 0.0125]), [thing("a", 0.2)]) == ""
