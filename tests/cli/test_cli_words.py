from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.cli.words import assignments, told_apart
from strands_robots.utils import ValidationError


def test_values_are_json_where_they_can_be_and_text_elsewhere() -> None:
    words = [
        "duration=1.5",
        "n_steps=3",
        "instruction=pick up the cube",
        'name="1.5"',
        "on=true",
        "pose=[1, 2]",
        "url=a=b",
    ]
    assert assignments(words) == {
        "duration": 1.5,
        "n_steps": 3,
        "instruction": "pick up the cube",
        "name": "1.5",
        "on": True,
        "pose": [1, 2],
        "url": "a=b",
    }


@pytest.mark.parametrize(
    "word", ["duration", "=3", "a b=3", "1a=3", "a-b=3", "x=NaN", "x=Infinity", "x=-Infinity", "x=1e999"]
)
def test_what_no_robot_can_take_is_refused(word: str) -> None:
    with pytest.raises(ValidationError):
        assignments([word])


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(ValidationError, match="twice"):
        assignments(["a=1", "a=2"])


def test_json_that_is_nested_too_deep_is_text() -> None:
    deep = "[" * 100_000
    assert assignments([f"a={deep}"]) == {"a": deep}


@given(st.text())
def test_any_word_is_read_or_refused_by_name(word: str) -> None:
    try:
        assignments([f"key={word}"])
    except ValidationError as refused:
        assert "key" in str(refused)


@pytest.mark.parametrize(
    ("words", "meeting", "serial"),
    [
        ([], None, None),
        (["7447"], 7447, None),
        (["/dev/ttyACM0"], None, "/dev/ttyACM0"),
        (["com3", "1"], 1, "com3"),
        (["65535", "/dev/serial/by-id/x"], 65535, "/dev/serial/by-id/x"),
    ],
)
def test_a_port_that_is_a_number_is_where_robots_meet_and_a_path_is_an_arms(
    words: list[str], meeting: int | None, serial: str | None
) -> None:
    assert told_apart(words) == (meeting, serial)


@pytest.mark.parametrize(
    "words", [["0"], ["65536"], ["-1"], [""], ["ttyACM0"], ["/"], ["1", "2"], ["/dev/a", "/dev/b"], ["7447.0"], ["²"]]
)
def test_any_other_port_is_refused(words: list[str]) -> None:
    with pytest.raises(ValidationError, match="--port"):
        told_apart(words)
