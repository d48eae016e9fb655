"""The result shape of every verb.

A success is ``{"status": "success", "content": [{"text": ...}, {"json": {...}}], **fields}``; an error also
has ``reason``, the sentence that its text repeats. The flat fields and the json block have the same data:
agents read the content, programs read the keys.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import plain_value, shown

Envelope = dict[str, Any]

DEPTH_MAX = 12
"""Levels of nesting that an answer may have on a wire; a deeper value is named, not sent."""


def success(text: str, **fields: Any) -> Envelope:
    """Return a success; ``fields`` become flat keys and the json block."""
    return {"status": "success", "content": _content(text, fields), **fields}


def error(reason: str, **fields: Any) -> Envelope:
    """Return a refusal or failure with its reason, one sentence."""
    return {"status": "error", "reason": reason, "content": _content(reason, fields), **fields}


def is_error(answer: object) -> bool:
    """Return True for an envelope that reports an error."""
    return isinstance(answer, dict) and answer.get("status") == "error"


def text_of(answer: Envelope) -> str:
    """Return the sentence of an envelope, or an empty string when it has none."""
    content = answer.get("content")
    for block in content if isinstance(content, list) else ():
        if isinstance(block, dict) and isinstance(block.get("text"), str):
            return str(block["text"])
    return str(answer.get("reason", answer.get("error", "")))


def fields_of(answer: object) -> dict[str, Any]:
    """Return the fields of an envelope: its keys over those of its json blocks."""
    if not isinstance(answer, Mapping):
        return {}
    fields: dict[str, Any] = {}
    content = answer.get("content")
    for block in content if isinstance(content, list) else ():
        inner = block.get("json") if isinstance(block, Mapping) else None
        if isinstance(inner, Mapping):
            fields.update(inner)
    return {**fields, **{key: value for key, value in answer.items() if key != "content"}}


def jsonable(value: object, depth: int = DEPTH_MAX) -> Any:
    """Return ``value`` in JSON's own types.

    NaN and infinities become null, a foreign object its short ``repr``.
    """
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
    plain = plain_value(value)
    return shown(value) if plain is value else jsonable(plain, depth - 1)


def uncarried(value: object, place: str = "", depth: int = DEPTH_MAX) -> str:
    """Return the first part of a value that JSON cannot carry and its place, or "".

    Numpy's scalars and arrays, and sets, are carried as :func:`jsonable` has them.
    """
    at, inner = place or "result", depth - 1
    if value is None or isinstance(value, bool | str):
        return ""
    if isinstance(value, float):
        return "" if math.isfinite(value) else f"{at} is {float(value)}"
    if isinstance(value, int):
        return "" if value.bit_length() <= 256 else f"{at} is {shown(value)}"
    if depth > 0 and isinstance(value, Mapping):
        odd = next((key for key in value if not isinstance(key, str | int | float | None)), None)
        if odd is not None and not hasattr(odd, "tolist"):
            return f"{at} has the key {shown(odd)}"
        rows = ((f"{place}.{key}" if place else str(key), each) for key, each in value.items())
        return next(filter(None, (uncarried(each, name, inner) for name, each in rows)), "")
    if depth > 0 and isinstance(value, list | tuple | set | frozenset):
        return next(filter(None, (uncarried(each, f"{at}[{n}]", inner) for n, each in enumerate(value))), "")
    if depth > 0 and getattr(getattr(value, "dtype", None), "kind", "") in ("b", "i", "u"):
        # A picture has a million numbers, none of which can be odd.
        return ""
    plain = plain_value(value) if depth > 0 else value
    return f"{at} is {shown(value)}" if plain is value else uncarried(plain, place, inner)


def _content(text: str, fields: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"text": text}, {"json": dict(fields)}] if fields else [{"text": text}]


class RefusalReason(Enum):
    """The part of the pipeline that refused a command."""

    ARGUMENTS = "arguments"
    CALLER = "caller"
    CONTROL = "control"
    LOCKOUT = "lockout"
    APPROVAL = "approval"
    BUSY = "busy"
    FAILED = "failed"

    def noted(self, envelope: Envelope) -> Envelope:
        """Return the envelope with the part that refused, for callers that are programs."""
        return {**envelope, "refused": self.value}


class Refused(StrandsRobotsError):  # noqa: N818 - a refusal, not a fault
    """A command that did not reach the robot, or failed in it.

    Args:
        text: what the caller is told.
        reason: what the audit is told; ``text`` by default.
        envelope: the whole answer, where it is more than ``text``.
    """

    def __init__(self, why: RefusalReason, text: str, reason: str = "", envelope: Envelope | None = None) -> None:
        super().__init__(text)
        self.why = why
        self.reason = reason or text
        self.envelope = why.noted(error(text) if envelope is None else envelope)
