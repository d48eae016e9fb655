"""Checks of actions and the bound of their speed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.policies.base import checked_action, checked_speeds, limited, numbers, plain_numbers, speeds_across
from strands_robots.utils import ValidationError

RANGES = {"a": (-1.0, 1.0), "b": (-math.inf, math.inf)}


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_finite_target_is_clamped_to_its_range(value: float) -> None:
    action = checked_action({"a": value, "b": value}, RANGES)
    assert -1 <= action["a"] <= 1
    assert action["b"] == value


@pytest.mark.parametrize(
    "bad", [math.nan, math.inf, -math.inf, True, None, "1", [1.0], np.array([1.0]), np.nan, 10**400]
)
def test_value_that_is_no_finite_number_is_refused_by_its_key(bad: object) -> None:
    with pytest.raises(ValidationError, match="'a'"):
        checked_action({"a": bad}, RANGES)


def test_numpy_scalars_are_accepted() -> None:
    assert checked_action({"a": np.float32(0.5), "b": np.array(2)}, RANGES) == {"a": 0.5, "b": 2.0}


@pytest.mark.parametrize("bad", [None, 5, [("a", 1.0)], {"c": 1.0}, {3: 1.0}])
def test_action_without_known_keys_is_refused(bad: object) -> None:
    with pytest.raises(ValidationError):
        checked_action(bad, RANGES)


def test_numbers_leaves_out_what_no_float_can_be() -> None:
    assert numbers({"huge": 10**400, "nan": float("nan"), "inf": float("-inf"), "pan": 1}) == {"pan": 1.0}


def test_numbers_leaves_out_images_flags_and_text() -> None:
    observation = {"a": np.float64(1), "b": 2, "c": True, "d": "x", "e": np.zeros((2, 2)), "f": math.nan, "g": None}
    assert numbers(observation) == {"a": 1.0, "b": 2.0}


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1", None, [1.0], np.zeros(3), {"position": math.nan}])
def test_plain_numbers_keeps_only_finite_numbers(value: object) -> None:
    assert plain_numbers({"a": value, "b": 1, "c": np.float64(2.5), "d": {"position": 3.0}}) == {
        "b": 1.0,
        "c": 2.5,
        "d": 3.0,
    }


@pytest.mark.parametrize("value", [None, [], "x", 3])
def test_plain_numbers_of_a_value_that_is_no_mapping_are_empty(value: object) -> None:
    assert plain_numbers(value) == {}


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.001, 0.1))
def test_speed_limit_bounds_every_step(before: float, wanted: float, dt: float) -> None:
    speeds = speeds_across(RANGES, full_ranges_per_s=2.0, unbounded_per_s=10.0)
    after = limited({"a": wanted, "b": wanted}, {"a": before, "b": before}, speeds, dt)
    assert abs(after["a"] - before) <= 4 * dt + 1e-9
    assert abs(after["b"] - before) <= 10 * dt + 1e-9
    assert min(before, wanted) - 1e-9 <= after["a"] <= max(before, wanted) + 1e-9


@pytest.mark.parametrize("bad", [0, -1, math.nan, math.inf, True, "1", {"c": 1.0}, {"a": 0}, {"a": True}])
def test_speed_limit_outside_its_domain_is_refused(bad: object) -> None:
    with pytest.raises(ValidationError, match="speed_limit"):
        checked_speeds(bad, RANGES)


def test_speed_limit_is_for_all_keys_or_for_those_it_names() -> None:
    assert checked_speeds(2, RANGES) == {"a": 2.0, "b": 2.0}
    assert checked_speeds({"b": 3.0}, RANGES) == {"b": 3.0}
