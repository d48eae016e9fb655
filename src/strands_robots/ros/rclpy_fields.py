"""Between the fields of a message, as callers write them, and a message class of a ROS 2 installation.

The classes tell their fields by ``get_fields_and_field_types``, in the words of the ROS 2 interface definition:
``double``, ``string<10>``, ``sequence<uint8>``, ``double[36]``, ``geometry_msgs/Vector3``.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from strands_robots.ros.link import RosError
from strands_robots.ros.names import class_place
from strands_robots.utils import shown

_SEQUENCE = re.compile(r"sequence<(.+?)(?:, *(\d+))?>\Z")
_ARRAY = re.compile(r"(.+)\[(\d+)\]\Z")
_INTEGER = re.compile(r"(u?)int(8|16|32|64)\Z")
_NUMBERS: dict[str, type] = {"float": float, "double": float, "long double": float, "boolean": bool}


def interface_class(kind: str, section: str) -> Any:
    """The Python class of an interface; ``section`` is msg, srv or action. Raises :class:`RosError`."""
    module, name = class_place(kind, section)
    try:
        found = getattr(import_module(module), name, None)
    except ModuleNotFoundError as exc:
        raise RosError(f"{kind} is not installed in the ROS 2 that is sourced: no module {exc.name}.") from exc
    if found is None:
        raise RosError(f"{kind} is not installed in the ROS 2 that is sourced: {module} has no {name}.")
    return found


def filled(message: Any, fields: Mapping[str, Any], place: str = "") -> Any:
    """``message`` with these fields set. Raises :class:`RosError` naming the field."""
    types = message.get_fields_and_field_types()
    for name, value in fields.items():
        if name not in types:
            raise RosError(f"{type(message).__name__} has no field {place}{name}; it has {', '.join(types)}.")
        where = f"{place}{name}"
        try:
            setattr(message, name, _value(types[name], value, where, getattr(message, name)))
        except (AssertionError, OverflowError) as exc:
            raise RosError(f"{where} must be a {types[name]}, not {shown(value)}.") from exc
    return message


def plain(message: Any) -> dict[str, Any]:
    """The fields of a message as numbers, text, bytes, lists and dictionaries."""
    types = message.get_fields_and_field_types()
    return {name: _plain(kind, getattr(message, name)) for name, kind in types.items()}


def _value(kind: str, value: Any, place: str, zero: Any = None) -> Any:
    if (several := _several(kind)) is not None:
        return _items(*several, value, place)
    if "/" in kind:
        if not isinstance(value, Mapping):
            raise RosError(f"{place} must be an object of fields, not {shown(value)}.")
        return filled(interface_class(kind, "msg")() if zero is None else zero, value, f"{place}.")
    if kind == "octet":
        if not isinstance(value, int) or isinstance(value, bool):
            raise RosError(f"{place} must be an octet, not {shown(value)}.")
        return value.to_bytes(1, "little")
    wanted = str if kind.partition("<")[0] in ("string", "wstring") else _NUMBERS.get(kind, int)
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


def _items(kind: str, length: int | None, value: Any, place: str) -> Any:
    if kind == "uint8" and str(getattr(value, "dtype", "")) == "uint8":
        value = value.tobytes()
    if kind == "uint8" and isinstance(value, bytes | bytearray):
        items: Any = bytes(value)
    else:
        items = value.tolist() if callable(getattr(value, "tolist", None)) else value
        if not isinstance(items, Sequence) or isinstance(items, str | bytes):
            raise RosError(f"{place} must be a list, not {shown(value)}.")
        items = [_value(kind, each, f"{place}[{n}]") for n, each in enumerate(items)]
    if length is not None and len(items) != length:
        raise RosError(f"{place} must have {length} items, not {len(items)}.")
    # An array of the right type is taken as it is; every other sequence would be checked number by number.
    return array("B", items) if kind == "uint8" and length is None else items


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


def _several(kind: str) -> tuple[str, int | None] | None:
    """What a list is made of, and how long it has to be where that is fixed; None for what is no list."""
    if (found := _SEQUENCE.match(kind)) is not None:
        return found[1], None
    if (found := _ARRAY.match(kind)) is not None:
        return found[1], int(found[2])
    return None
