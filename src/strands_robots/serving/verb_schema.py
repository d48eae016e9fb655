"""Descriptions of verbs as they are sent: name, text, JSON Schema, labels."""

from __future__ import annotations

from typing import Any

from strands_robots.serving.verbs import REQUIRED, Kind, Parameter, Verb
from strands_robots.verb_parameters import JSON_TYPES

Labels = dict[str, str | list[str]]


def labels_of(verb: Verb) -> Labels:
    """Return the labels of a verb: direction, whose it is, seconds to return."""
    kind: Labels = {"direction": "read"} if verb.kind is Kind.READ else {"direction": "write"}
    if verb.kind is not Kind.READ and verb.critical:
        kind["safety"] = "critical"
    if verb.own:
        kind["own"] = "true"
    duration = verb.by_name.get("duration") if verb.lasts else None
    lasts_s = verb.lasts_s if duration is None else float(duration.default)
    if lasts_s:
        kind["lasts_s"] = f"{lasts_s:g}"
    return kind


def text_of(verb: Verb) -> str:
    """Return the text that describes a verb and its parameters."""
    lines = [verb.summary, *(["", verb.note] if verb.note else [])]
    if verb.parameters:
        lines += ["", "Args:", *(f"    {each.name}: {each.meaning}" for each in verb.parameters)]
    return "\n".join(lines)


def described(verb: Verb) -> dict[str, Any]:
    """Return the description of a verb, in Device Connect's shape for a function."""
    return {
        "name": verb.name,
        "description": text_of(verb),
        "parameters": {
            "type": "object",
            "properties": {each.name: _schema(each) for each in verb.parameters},
            "required": [each.name for each in verb.parameters if each.default is REQUIRED],
        },
        "labels": labels_of(verb),
    }


def _schema(parameter: Parameter) -> dict[str, Any]:
    if parameter.schema is not None:
        return dict(parameter.schema)
    kind = {"type": JSON_TYPES.get(parameter.type, "string"), "description": parameter.meaning}
    return kind if parameter.default is REQUIRED else {**kind, "default": parameter.default}
