"""Messages of a ROS graph from fields, and back.

A message class describes its fields by ``get_fields_and_field_types``, in the terms of the ROS 2 interface definition:
``double``, ``string<10>``, ``sequence<uint8>``, ``double[36]``, ``geometry_msgs/Vector3``. Those of bare DDS say
``float``, ``int``, ``bool``, ``str`` and ``bytes`` as well.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from strands_robots.ros.link import RosError
from strands_robots.utils import shown

NewMessage = Callable[[str], Any]
"""Returns an empty message of a kind."""

_SEQUENCE = re.compile(r"sequence<(.+?)(?:, *(\d+))?>\Z")
_ARRAY = re.compile(r"(.+)\[(\d+)\]\Z")
_INTEGER = re.compile(r"(u?)int(8|16|32|64)\Z")
_PLAIN: dict[str, type] = {
    **dict.fromkeys(("float", "double", "long double"), float),
    **dict.fromkeys(("boolean", "bool"), bool),
    **dict.fromkeys(("string", "wstring", "str"), str),
}


def filled(message: Any, fields: Mapping[str, Any], new: NewMessage, place: str = "") -> Any:
    """Set fields of ``message`` and return it; a wrong one is a RosError."""
    types = message.get_fields_and_field_types()
    for name, value in fields.items():
        if name not in types:
            raise RosError(f"{type(message).__name__} has no field {place}{name}; it has {', '.join(types)}.")
        where = f"{place}{name}"
        try:
            setattr(message, name, _value(types[name], value, where, new, getattr(message, name)))
        except (AssertionError, OverflowError) as exc:
            raise RosError(f"{where} must be a {types[name]}, not {shown(value)}.") from exc
    return message


def plain(message: Any) -> dict[str, Any]:
    """Return the fields of a message as numbers, text, bytes, lists and dictionaries."""
    types = message.get_fields_and_field_types()
    return {name: _plain(kind, getattr(message, name)) for name, kind in types.items()}


def _value(kind: str, value: Any, place: str, new: NewMessage, zero: Any = None) -> Any:
    if (several := _several(kind)) is not None:
        return _items(*several, value, place, new)
    if "/" in kind:
        if not isinstance(value, Mapping):
            raise RosError(f"{place} must be an object of fields, not {shown(value)}.")
        return filled(new(kind) if zero is None else zero, value, new, f"{place}.")
    if kind == "bytes":
        return _bytes(value, place)
    if kind == "octet":
        if not isinstance(value, int) or isinstance(value, bool):
            raise RosError(f"{place} must be an octet, not {shown(value)}.")
        return value.to_bytes(1, "little")
    wanted = _PLAIN.get(kind.partition("<")[0], int)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise RosError(f"{place} must be a {kind}, not {shown(value)}.")
    # Newer ROS 2 checks no value in its setters, and the conversion to C would cut an integer.
    return _whole(kind, value, place) if isinstance(value, int) else value


def _whole(kind: str, value: int, place: str) -> int:
    integer = _INTEGER.match(kind)
    if integer is not None:
        bits = int(integer[2])
        low, high = (0, 2**bits) if integer[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        if not low <= value < high:
            raise RosError(f"{place} must be a {kind}, from {low} to {high - 1}, not {shown(value)}.")
    return value


def _items(kind: str, length: int | None, value: Any, place: str, new: NewMessage) -> Any:
    if kind == "uint8" and str(getattr(value, "dtype", "")) == "uint8":
        value = value.tobytes()
    if kind == "uint8" and isinstance(value, bytes | bytearray):
        items: Any = bytes(value)
    else:
        items = value.tolist() if callable(getattr(value, "tolist", None)) else value
        if not isinstance(items, Sequence) or isinstance(items, str | bytes):
            raise RosError(f"{place} must be a list, not {shown(value)}.")
        items = [_value(kind, each, f"{place}[{n}]", new) for n, each in enumerate(items)]
    if length is not None and len(items) != length:
        raise RosError(f"{place} must have {length} items, not {len(items)}.")
    # An array of the right type is taken as it is; every other sequence would be checked number by number.
    return array("B", items) if kind == "uint8" and length is None else items


def _bytes(value: Any, place: str) -> bytes:
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    tobytes = getattr(value, "tobytes", None)
    if callable(tobytes):
        return bytes(tobytes())
    try:
        return bytes(value) if isinstance(value, list) else bytes([-1])
    except (TypeError, ValueError):
        raise RosError(f"{place} must be bytes or a list of them, not {shown(value)}.") from None


def _plain(kind: str, value: Any) -> Any:
    several = _several(kind)
    if several is not None:
        if several[0] == "uint8":
            return bytes(value)
        if "/" in several[0] or several[0] == "octet":
            return [_plain(several[0], each) for each in value]
        return value.tolist() if callable(getattr(value, "tolist", None)) else list(value)
    if "/" in kind:
        return plain(value)
    return value[0] if kind == "octet" else value


@lru_cache(maxsize=256)
def _several(kind: str) -> tuple[str, int | None] | None:
    """Return the item type and the fixed length of a list; None for other types."""
    if (found := _SEQUENCE.match(kind)) is not None:
        return found[1], None
    if (found := _ARRAY.match(kind)) is not None:
        return found[1], int(found[2])
    return None
