"""JSON of others: what is parsed, and what is refused before it is."""

from __future__ import annotations

import base64
import json
import os

import pytest

from strands_robots.bounded_json import (
    DEPTH_MAX,
    ELEMENTS_MAX,
    FREE_BYTES,
    LONG_MAX,
    MESSAGE_MAX,
    OutOfBoundsError,
    json_object,
    parsed,
    refusal,
)

PICTURE = base64.b64encode(os.urandom(2 * 2**20)).decode()


@pytest.mark.parametrize(
    "data",
    [b"", b"[1]", b"7", b"null", b"\xff", b"{", "{'a': 1}", b"[" * 60_000, b"[" * 200_000, '{"a":' * 200_000],
)
def test_what_is_no_json_object_is_read_as_an_empty_one(data: str | bytes) -> None:
    assert json_object(data) == {}


def test_a_json_object_is_read_from_text_and_bytes() -> None:
    assert json_object('{"a": [1]}') == json_object(b'{"a": [1]}') == {"a": [1]}


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize(
    "value",
    [
        {"jpeg": PICTURE[:700_000], "width": 640},
        {"ranges": [round(0.1 + i / 7, 12) for i in range(15_000)]},
        {"joints": {f"joint_{i}": i / 7 for i in range(15_000)}},
        {"text": "ä" * 100_000},
        {"text": "12345 " * 100_000},
    ],
    ids=["picture", "scan", "joints", "letters", "digits"],
)
def test_long_message_of_a_robot_is_read(value: object, as_bytes: bool) -> None:
    text = json.dumps(value, ensure_ascii=False)
    assert parsed(text.encode() if as_bytes else text) == value


def test_picture_above_a_megabyte_is_read_where_its_bound_allows() -> None:
    text = json.dumps({"png": PICTURE})
    assert len(text) > MESSAGE_MAX
    assert parsed(text, LONG_MAX) == parsed(text.encode(), LONG_MAX) == {"png": PICTURE}
    with pytest.raises(OutOfBoundsError, match="at most 1048576 are read"):
        parsed(text)


LISTS = "[" + "[]," * 20_000 + "[]]"
KEYS = json.dumps({f"{i:x}": 0 for i in range(ELEMENTS_MAX + 2)})


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize(
    ("text", "longest", "why"),
    [
        ("x" * 101, 100, "101 bytes, and at most 100 are read"),
        (LISTS + " " * FREE_BYTES, MESSAGE_MAX, "more than 20000 values"),
        (KEYS, MESSAGE_MAX, "more than 20000 values"),
        ('["' + "ä" * 300_000 + '"]', MESSAGE_MAX, "outside ASCII"),
        ("[1" + " " * FREE_BYTES + "9" * 500 + "]", MESSAGE_MAX, "hundreds of digits"),
        ('["' + PICTURE + '", ' + "1, " * 2000 + "1]", LONG_MAX, "more than 1000 values or escapes"),
        ('["' + PICTURE + "\\n" * 2000 + '"]', LONG_MAX, "more than 1000 values or escapes"),
        ('["' + PICTURE + '", ' + "9" * 2000 + "]", LONG_MAX, "hundreds of digits"),
    ],
    ids=["length", "lists", "keys", "letters", "number", "values", "escapes", "number beside a picture"],
)
def test_message_out_of_bounds_is_refused_unparsed(text: str, longest: int, why: str, as_bytes: bool) -> None:
    data: str | bytes = text.encode() if as_bytes else text
    assert why in refusal(data, longest)

    def parse(data: object) -> object:
        raise AssertionError("it was parsed")

    with pytest.raises(OutOfBoundsError, match=why):
        parsed(data, longest, parse)


def test_nesting_is_bounded() -> None:
    nested = "[" * DEPTH_MAX + "1" + "]" * DEPTH_MAX
    assert parsed(nested)
    with pytest.raises(OutOfBoundsError, match="deeper than 64"):
        parsed(f"[{nested}]")
    assert parsed('["' + "[" * 200 + '"]') == ["[" * 200]
