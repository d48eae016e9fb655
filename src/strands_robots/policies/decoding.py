"""Foreign MessagePack and JSON, within bounds on bytes, elements and depth.

A megabyte of empty lists becomes a hundred megabytes of objects, and the parser keeps the interpreter from a stop
meanwhile. So a message is measured first: its length, then the elements that it states and how deep they are nested.
What is beyond a bound is refused before an object is made of it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from strands_robots.bounded_json import OutOfBoundsError, parsed
from strands_robots.utils import ValidationError

MESSAGE_MAX = 2**20
"""Longest message, in bytes: forty times a chunk of a hundred actions of 32 joints in float64."""

ELEMENTS_MAX = 12_000
"""Most values in a message, keys included: twice a chunk of a hundred actions, each a map of 32 joints."""

DEPTH_MAX = 32
"""Deepest nesting; an answer of GR00T has five."""


class ForeignDataError(ValidationError):
    """A message that is beyond a bound, or malformed; the text names which."""


def decode_msgpack(data: bytes) -> Any:
    """Return what a MessagePack message holds; its extensions are refused.

    Raises:
        ForeignDataError: it is beyond a bound, cut off, or no MessagePack.
    """
    import msgpack  # noqa: PLC0415 - an extra

    _within("bytes", len(data), MESSAGE_MAX)
    _measure(data)
    try:
        return msgpack.unpackb(data, strict_map_key=False)
    except (ValueError, TypeError) as exc:
        raise ForeignDataError(f"it is malformed: {type(exc).__name__}: {exc!s:.200}") from None


def decode_json(data: str | bytes) -> Any:
    """Return what a JSON message holds.

    Separators are counted in place of elements, also those inside of texts.

    Raises:
        ForeignDataError: it is beyond a bound, or no JSON.
    """
    _within("bytes", len(data), MESSAGE_MAX)
    _within("elements", _marks(data), ELEMENTS_MAX)
    try:
        return parsed(data, MESSAGE_MAX, depth=DEPTH_MAX)
    except OutOfBoundsError as exc:
        raise ForeignDataError(str(exc)) from None
    except ValueError as exc:
        raise ForeignDataError(f"it is malformed: {type(exc).__name__}: {exc!s:.200}") from None


def decode_file(data: bytes, *, bytes_max: int = MESSAGE_MAX, elements_max: int = ELEMENTS_MAX) -> Any:
    """Return what the JSON text of a file holds, which may have more than a message.

    Raises:
        ForeignDataError: it is beyond a bound, or no JSON.
    """
    _within("bytes", len(data), bytes_max)
    _within("elements", _marks(data), elements_max)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as exc:
        raise ForeignDataError(f"it is malformed: {type(exc).__name__}: {exc!s:.200}") from None


def read_json(path: Path) -> Any:
    """Return what a JSON file holds; no more of it is read than a message may have.

    Raises:
        ForeignDataError: it is beyond a bound, or no JSON.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return decode_file(file.read(MESSAGE_MAX + 1))


def _marks(data: str | bytes) -> int:
    return sum(map(data.count, ",[{:") if isinstance(data, str) else map(data.count, b",[{:"))


def _within(what: str, count: int, most: int) -> None:
    if count > most:
        raise ForeignDataError(f"it has {count:,} {what}, and may have {most:,}")


_SIZES = [1] * 128 + [0] * 32 + [1 + length for length in range(32)] + [0] * 32 + [1] * 32
"""Bytes of a value by its first byte, its head included; 0 where more of the head has to be read."""
for _code, _size in {0xC0: 1, 0xC2: 1, 0xC3: 1, 0xCA: 5, 0xCB: 9}.items():
    _SIZES[_code] = _size
for _code in range(8):
    # Unsigned and signed integers of 8, 16, 32 and 64 bits.
    _SIZES[0xCC + _code] = 1 + (1 << _code % 4)

_HEADS = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
"""Bytes of the length of texts and binaries, by the first byte."""

_CONTAINERS = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}
"""Bytes of the length of lists and maps, and the elements of one item."""


def _measure(data: bytes) -> None:
    """Walk a message without making anything of it.

    Format: the MessagePack specification. A length is believed only as far as it is within the bounds.

    Raises:
        ForeignDataError: more elements than ELEMENTS_MAX, deeper than DEPTH_MAX, cut off, or an extension.
    """
    sizes, end = _SIZES, len(data)
    at, total, left = 0, 1, 1
    above: list[int] = []
    """Elements that are still to come in each container around the present one."""
    while True:
        while not left:
            if not above:
                return
            left = above.pop()
        left -= 1
        if at >= end:
            raise ForeignDataError("it is cut off")
        code = data[at]
        if size := sizes[code]:
            at += size
            continue
        if code in _HEADS:
            width = _HEADS[code]
            at += 1 + width + int.from_bytes(data[at + 1 : at + 1 + width])
            continue
        if 0x80 <= code < 0xA0:
            width, count = 0, (code & 0x0F) * (1 if code >= 0x90 else 2)
        elif code in _CONTAINERS:
            width, each = _CONTAINERS[code]
            count = int.from_bytes(data[at + 1 : at + 1 + width]) * each
        else:
            raise ForeignDataError(f"it has a value of the kind 0x{code:02x}, which is not read")
        at += 1 + width
        if count:
            total += count
            above.append(left)
            left = count
            if total > ELEMENTS_MAX or len(above) > DEPTH_MAX:
                _within("elements", total, ELEMENTS_MAX)
                _within("levels", len(above), DEPTH_MAX)
