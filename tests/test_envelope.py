"""The result shape of every verb."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots import envelope
from strands_robots.envelope import fields_of, jsonable, success


def test_success_has_its_fields_flat_and_as_json() -> None:
    answer = envelope.success("Done.", steps=3)
    assert answer == {"status": "success", "content": [{"text": "Done."}, {"json": {"steps": 3}}], "steps": 3}
    assert not envelope.is_error(answer)


def test_error_gives_its_reason_as_field_and_as_text() -> None:
    answer = envelope.error("No.", stopped=False)
    assert answer["reason"] == envelope.text_of(answer) == "No."
    assert answer["stopped"] is False
    assert answer["content"][1] == {"json": {"stopped": False}}
    assert envelope.is_error(answer)


def test_answer_without_fields_has_text_alone() -> None:
    assert envelope.success("Done.")["content"] == [{"text": "Done."}]


def test_foreign_value_is_no_error_and_has_no_text() -> None:
    assert not envelope.is_error(None)
    assert envelope.text_of({}) == ""
    assert envelope.text_of({"reason": "why"}) == "why"
    assert envelope.text_of({"content": ["?", {"text": 5}, {"text": "yes"}]}) == "yes"


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary() | st.complex_numbers(),
    lambda inner: (
        st.lists(inner) | st.sets(st.integers()) | st.tuples(inner, inner) | st.dictionaries(st.integers(), inner)
    ),
)


@given(anything)
def test_jsonable_makes_any_value_valid_json(value: object) -> None:
    json.dumps(jsonable(value), allow_nan=False)


@given(st.recursive(st.none() | st.booleans() | st.text() | st.integers(-(2**60), 2**60), st.lists, max_leaves=5))
def test_jsonable_keeps_plain_values(value: object) -> None:
    assert jsonable(value) == value


def test_jsonable_bounds_the_depth() -> None:
    deep: object = 1
    for _ in range(10_000):
        deep = [deep]
    assert len(json.dumps(jsonable(deep))) < 500


def test_jsonable_turns_numpy_into_lists_and_nan_into_null() -> None:
    plain = jsonable({"a": np.float32(0.5), "b": np.arange(3), "c": np.array([math.nan]), "d": math.inf})
    assert plain == {"a": 0.5, "b": [0, 1, 2], "c": [None], "d": None}


@pytest.mark.parametrize("value", [None, [], "x", 3])
def test_fields_of_a_value_that_is_no_mapping_are_empty(value: object) -> None:
    assert fields_of(value) == {}


def test_fields_of_an_envelope_come_from_its_keys_and_its_json_come_from_its_keys_and_its_json() -> None:
    assert fields_of(success("ok", task_status="running"))["task_status"] == "running"
    assert fields_of({"status": "success", "content": [{"json": {"steps": 3}}, {"text": "x"}, 5]})["steps"] == 3
