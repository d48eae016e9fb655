"""Between the fields of a message, as callers write them, and an IDL struct: every value checked by its place."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_type_hints

from strands_robots.ros.link import RosError
from strands_robots.utils import shown


def filled(struct: type[Any], fields: Mapping[str, Any], place: str = "") -> Any:
    """An instance with these fields; what is left out is zero. Raises :class:`RosError` naming the field."""
    hints = get_type_hints(struct, include_extras=True)
    message = struct()
    for name, value in fields.items():
        if name not in hints:
            raise RosError(f"{struct.__name__} has no field {place}{name}; it has {', '.join(hints)}.")
        setattr(message, name, _value(hints[name], getattr(message, name), value, f"{place}{name}"))
    return message


def plain(message: Any) -> dict[str, Any]:
    """The fields of a message as numbers, text, bytes, lists and dictionaries."""
    return {each.name: _plain(getattr(message, each.name)) for each in dataclasses.fields(message)}


def _value(hint: Any, zero: Any, value: Any, place: str) -> Any:
    if dataclasses.is_dataclass(zero):
        if not isinstance(value, Mapping):
            raise RosError(f"{place} must be an object of fields, not {shown(value)}.")
        return filled(type(zero), value, f"{place}.")
    if isinstance(zero, bytes):
        return _bytes(value, place)
    if isinstance(zero, list):
        return _items(hint, zero, value, place)
    if isinstance(zero, bool) or isinstance(value, bool):
        fits = isinstance(zero, bool) and isinstance(value, bool)
    elif isinstance(zero, float):
        fits = isinstance(value, int | float)
        value = float(value) if fits else value
    else:
        fits = isinstance(value, type(zero))
    if not fits:
        raise RosError(f"{place} must be a {type(zero).__name__}, not {shown(value)}.")
    return value


def _items(hint: Any, zero: list[Any], value: Any, place: str) -> list[Any]:
    listed = value.tolist() if callable(getattr(value, "tolist", None)) else value
    if not isinstance(listed, Sequence) or isinstance(listed, str | bytes):
        raise RosError(f"{place} must be a list, not {shown(value)}.")
    if zero and len(listed) != len(zero):
        raise RosError(f"{place} must have {len(zero)} items, not {len(listed)}.")
    kind = _item_type(hint)
    return [_value(kind, kind(), each, f"{place}[{n}]") for n, each in enumerate(listed)]


def _item_type(hint: Any) -> Any:
    inner = get_args(get_args(hint)[0])[0]
    # A number's type is Annotated[float, "float64"]; that of text and structs is itself.
    parts = get_args(inner)
    return parts[0] if parts else inner


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


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return plain(value)
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value
