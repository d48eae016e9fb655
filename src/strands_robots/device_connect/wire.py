"""What leaves the process as JSON: plain values only, and no number that JSON cannot carry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from strands_robots.utils import shown

DEEPEST = 12
"""Levels of nesting that an answer may have; what is deeper is named, not sent."""


def jsonable(value: object, depth: int = DEEPEST) -> Any:
    """``value`` with JSON's own types alone: NaN and infinities become null, a foreign object its short ``repr``."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, int):
        return int(value) if value.bit_length() <= 256 else shown(value)
    if depth == 0:
        return shown(value)
    if isinstance(value, Mapping):
        return {str(key): jsonable(item, depth - 1) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(item, depth - 1) for item in value]
    plain = getattr(value, "tolist", None)  # numpy's scalars and arrays
    return jsonable(plain(), depth - 1) if callable(plain) else shown(value)


def numbers(values: object) -> dict[str, float]:
    """The finite numbers of a mapping, by name; a joint given as ``{"position": x, ...}`` counts by its position."""
    found: dict[str, float] = {}
    for name, value in values.items() if isinstance(values, Mapping) else ():
        item: Any = value.get("position") if isinstance(value, Mapping) else value
        plain = item.item() if hasattr(item, "item") and getattr(item, "ndim", 0) == 0 else item
        if isinstance(plain, int | float) and not isinstance(plain, bool) and math.isfinite(plain):
            found[str(name)] = float(plain)
    return found


def record(answer: object) -> dict[str, Any]:
    """The facts of an envelope in one flat mapping: its keys over those of its json blocks."""
    if not isinstance(answer, Mapping):
        return {}
    facts: dict[str, Any] = {}
    content = answer.get("content")
    for block in content if isinstance(content, list) else ():
        inner = block.get("json") if isinstance(block, Mapping) else None
        if isinstance(inner, Mapping):
            facts.update(inner)
    facts.update({key: value for key, value in answer.items() if key != "content"})
    return facts
