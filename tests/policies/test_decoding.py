"""Foreign messages within bounds: what is read, what is refused, and what it costs."""

from __future__ import annotations

import json
import struct
from typing import Any

import msgpack
import pytest
from fixtures.policy_bombs import BELOW, packed, texts
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.policies import decoding
from strands_robots.policies.decoding import (
    DEPTH_MAX,
    ELEMENTS_MAX,
    MESSAGE_MAX,
    ForeignDataError,
    decode_json,
    decode_msgpack,
)

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=400)
    | st.binary(max_size=70_000),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=5) | st.integers(0, 9), inner),
    max_leaves=60,
)


@given(VALUES)
def test_every_message_within_the_bounds_is_read_as_msgpack_reads_it(value: Any) -> None:
    assert decode_msgpack(msgpack.packb(value)) == value


@given(VALUES, st.data())
def test_a_message_that_is_cut_off_is_refused(value: Any, data: st.DataObject) -> None:
    whole = msgpack.packb(value)
    with pytest.raises(ForeignDataError):
        decode_msgpack(whole[: data.draw(st.integers(0, len(whole) - 1))])


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([None] * ELEMENTS_MAX, f"{ELEMENTS_MAX + 1:,} elements"),
        ([[None]] * (ELEMENTS_MAX // 2), "elements"),
        (dict.fromkeys(range(ELEMENTS_MAX // 2)), "elements"),
        (bytes(MESSAGE_MAX), "bytes"),
        (msgpack.ExtType(5, b"x"), "kind 0xd4"),
        (msgpack.Timestamp(0), "kind 0xd6"),
    ],
    ids=lambda value: None if not isinstance(value, str) else value,
)
def test_a_message_beyond_a_bound_is_refused_by_name(value: Any, words: str) -> None:
    with pytest.raises(ForeignDataError, match=words):
        decode_msgpack(msgpack.packb(value))


def test_the_bounds_themselves_are_within() -> None:
    deep: Any = 0
    for _ in range(DEPTH_MAX):
        deep = [deep]
    assert decode_msgpack(msgpack.packb(deep)) == deep
    with pytest.raises(ForeignDataError, match="33 levels"):
        decode_msgpack(msgpack.packb([deep]))
    many = [None] * (ELEMENTS_MAX - 1)
    assert decode_msgpack(msgpack.packb(many)) == many
    longest = bytes(MESSAGE_MAX - 5)
    assert decode_msgpack(msgpack.packb(longest)) == longest


@pytest.mark.parametrize("name", [name for name in packed(BELOW) if not name.startswith(("one text", "texts as"))])
def test_no_bomb_reaches_the_parser(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name != "a text that is no UTF-8":
        monkeypatch.setattr(msgpack, "unpackb", lambda *given, **more: pytest.fail("it was parsed"))
    with pytest.raises(ForeignDataError):
        decode_msgpack(packed(BELOW)[name])


@pytest.mark.parametrize("name", [name for name in texts(BELOW) if not name.startswith("one text")])
def test_a_bomb_of_json_is_refused(name: str) -> None:
    with pytest.raises(ForeignDataError):
        decode_json(texts(BELOW)[name])
    with pytest.raises(ForeignDataError):
        decode_json(texts(BELOW)[name].encode())


def test_elements_of_json_are_counted_before_it_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoding, "parsed", lambda *given, **more: pytest.fail("it was parsed"))
    for data in ('{"a":' * 11_000, "[1," * 11_000, b"[1," * 11_000, "x" * (MESSAGE_MAX + 1)):
        with pytest.raises(ForeignDataError, match=r"elements|bytes"):
            decode_json(data)


def test_a_chunk_of_a_hundred_actions_of_32_joints_is_far_within_the_bounds() -> None:
    chunk = {"actions": [{f"joint_{number}": 0.5 for number in range(32)}] * 100}
    assert decode_msgpack(msgpack.packb(chunk)) == decode_json(json.dumps(chunk)) == chunk
    array = {"data": struct.pack("<3200d", *range(3200))}
    assert len(msgpack.packb(array)) * 20 < decoding.MESSAGE_MAX
