"""JSON from a network, parsed within bounds on time and memory.

The parser holds the interpreter until it is done, and with it every stop of the process: 8 MB of empty lists take a
second. A message is therefore measured before it is parsed, by its length and by a count of the characters that make
values. What is within its bounds is parsed in less than 20 ms and 10 MB.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from strands_robots.errors import StrandsRobotsError

MESSAGE_MAX = 2**20
"""Longest message, in bytes, where a topic has no bound of its own: what a NATS server carries by default."""

LONG_MAX = 4 * MESSAGE_MAX
"""Longest answer to a request, which may be a picture."""

SMALL_BYTES = 64 * 2**10
"""Longest message of topics that carry no data, such as stops and a daemon's status."""

FREE_BYTES = 16 * 2**10
"""A message of this length may hold anything: it is parsed in 2 ms and 1 MB at most."""

ELEMENTS_MAX = 20_000
"""Values of a longer message: commas, and opening brackets twice, because a container costs most."""

PICTURE_ELEMENTS_MAX = 1000
"""Marks of each kind in a message above :data:`MESSAGE_MAX`: what is so long holds a picture, and in ASCII."""

DEPTH_MAX = 64
"""Deepest nesting; no message of a robot comes near."""

DIGITS_MAX = 400
"""Digits in a row. Python takes the square of their number to read a number, and base64 has far fewer."""


class OutOfBoundsError(StrandsRobotsError, ValueError):
    """A text that is not parsed, or nests too deep; the message says why."""


def refusal(data: bytes | str, longest: int = MESSAGE_MAX) -> str:
    """Return the reason why a JSON text is not parsed, or nothing.

    Args:
        data: UTF-8, or text.
        longest: its bound, in bytes or letters. Above a quarter of :data:`MESSAGE_MAX` a text has to be ASCII: Python
            takes four bytes for each letter of any other.
    """
    size = len(data)
    if size > longest:
        return f"it has {size} bytes, and at most {longest} are read"
    if size <= FREE_BYTES:
        return ""
    if not data.isascii() and 4 * size > MESSAGE_MAX:
        return f"it has {size} bytes outside ASCII, and at most {MESSAGE_MAX // 4} are read"
    if size > MESSAGE_MAX:
        if any(_more_than(data, mark, PICTURE_ELEMENTS_MAX) for mark in ",[{\\"):
            return f"it has {size} bytes and more than {PICTURE_ELEMENTS_MAX} values or escapes"
    elif _count(data, ",") + 2 * (_count(data, "[") + _count(data, "{")) > ELEMENTS_MAX:
        return f"it has more than {ELEMENTS_MAX} values"
    return "it has a number of hundreds of digits" if _long_number(data) else ""


def parsed(
    data: bytes | str, longest: int = MESSAGE_MAX, parse: Callable[[Any], Any] = json.loads, *, depth: int = DEPTH_MAX
) -> Any:
    """Return the value of a JSON text.

    Args:
        data: the text.
        longest: its bound, as in :func:`refusal`.
        parse: the parser of ``data``.
        depth: deepest nesting.

    Raises:
        OutOfBoundsError: it is out of its bounds, or nests deeper than ``depth``.
        ValueError: it is no JSON.
    """
    # A short text, as every stop is, is not measured: it may hold anything.
    why = refusal(data, longest) if len(data) > min(longest, FREE_BYTES) else ""
    if why:
        raise OutOfBoundsError(why)
    try:
        value = parse(data)
    except RecursionError:
        raise OutOfBoundsError(f"it is nested deeper than {depth}") from None
    marks = data.count("[") + data.count("{") if isinstance(data, str) else data.count(b"[") + data.count(b"{")
    if marks > depth and _deeper_than(value, depth):
        raise OutOfBoundsError(f"it is nested deeper than {depth}")
    return value


def json_object(data: bytes | str, longest: int = MESSAGE_MAX) -> dict[str, Any]:
    """Return the JSON object in ``data``; an empty one for anything else."""
    try:
        found = parsed(data, longest)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _count(data: bytes | str, mark: str) -> int:
    return data.count(mark) if isinstance(data, str) else data.count(mark.encode())


def _more_than(data: bytes | str, mark: str, most: int) -> bool:
    """Return True where ``mark`` is found more often; quick where it is rare."""
    at = -1
    for _ in range(most + 1):
        at = data.find(mark, at + 1) if isinstance(data, str) else data.find(mark.encode(), at + 1)
        if at < 0:
            return False
    return True


def _long_number(data: bytes | str) -> bool:
    """Return True where more than :data:`DIGITS_MAX` digits stand in a row.

    In a long message a sample is enough: there are few values, and a text in base64 is not taken for a number.
    """
    length = DIGITS_MAX
    if len(data) > MESSAGE_MAX:
        data, length = data[::_STRIDE], _SAMPLED
    digits = data.encode("utf-8", "replace") if isinstance(data, str) else data
    return b"0" * length in digits.translate(_AS_ZEROS)


def _deeper_than(value: object, limit: int) -> bool:
    """Return True when ``value`` nests deeper; uses no stack."""
    level: list[object] = [value]
    for _ in range(limit):
        level = [
            child
            for node in level
            for child in (node.values() if isinstance(node, dict) else node if isinstance(node, list) else ())
            if child and isinstance(child, dict | list)
        ]
        if not level:
            return False
    return True


# So many digits in a row, each 41st letter: a number of 656 digits.
_STRIDE, _SAMPLED = 41, 16
_AS_ZEROS = bytes(0x30 if each in b"0123456789" else 0x2E for each in range(256))
