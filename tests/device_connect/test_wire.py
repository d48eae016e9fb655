"""What leaves the process as JSON."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.device_connect.wire import jsonable, numbers, record
from strands_robots.envelope import success

anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary() | st.complex_numbers(),
    lambda inner: (
        st.lists(inner) | st.sets(st.integers()) | st.tuples(inner, inner) | st.dictionaries(st.integers(), inner)
    ),
)


@given(anything)
def test_whatever_goes_in_json_comes_out(value: object) -> None:
    json.dumps(jsonable(value), allow_nan=False)


@given(st.recursive(st.none() | st.booleans() | st.text() | st.integers(-(2**60), 2**60), st.lists, max_leaves=5))
def test_what_json_can_carry_stays_as_it_is(value: object) -> None:
    assert jsonable(value) == value


def test_depth_is_bounded() -> None:
    deep: object = 1
    for _ in range(10_000):
        deep = [deep]
    assert len(json.dumps(jsonable(deep))) < 500


def test_numpy_and_nan_become_plain() -> None:
    plain = jsonable({"a": np.float32(0.5), "b": np.arange(3), "c": np.array([math.nan]), "d": math.inf})
    assert plain == {"a": 0.5, "b": [0, 1, 2], "c": [None], "d": None}


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1", None, [1.0], np.zeros(3), {"position": math.nan}])
def test_only_finite_numbers_count_as_numbers(value: object) -> None:
    assert numbers({"a": value, "b": 1, "c": np.float64(2.5), "d": {"position": 3.0}}) == {"b": 1.0, "c": 2.5, "d": 3.0}


@pytest.mark.parametrize("value", [None, [], "x", 3])
def test_what_is_no_mapping_has_no_numbers_and_no_facts(value: object) -> None:
    assert numbers(value) == {}
    assert record(value) == {}


def test_the_facts_of_an_envelope_come_from_its_keys_and_its_json() -> None:
    assert record(success("ok", task_status="running"))["task_status"] == "running"
    assert record({"status": "success", "content": [{"json": {"steps": 3}}, {"text": "x"}, 5]})["steps"] == 3
