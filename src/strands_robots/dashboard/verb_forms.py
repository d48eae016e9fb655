"""Forms of a robot's verbs, made from the descriptions of serving."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any

from strands_robots.serving.control_verbs import CONTROL_VERBS
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.verbs import LEASE_NAMES, REQUIRED, Kind, Verb

LEFT_OUT = frozenset({*CONTROL_VERBS, "resume", "ping", "teleop_status", "teleop_receive", "teleop_stop"})
"""Verbs that the page has a control of its own for, or none."""

FORMS_MAX, PARAMETERS_MAX, TEXT_MAX = 100, 40, 600

SHOWN_AT_LEAST = 2
SHOWN = {
    "pick": ("object", "speed"),
    "place": ("on", "x", "y"),
    "moveBy": ("direction", "distance"),
    "getPicture": ("camera",),
}
"""Fields that a form shows unfolded, where they are not the required ones and those that come first."""

_UNITS = (
    (re.compile(r"\bdegrees\b", re.I), "\u00b0"),
    (re.compile(r"\bmetres\b", re.I), "m"),
    (re.compile(r"\b(in )?seconds\b|\bLongest wait\b", re.I), "s"),
    (re.compile(r"\bpixels\b", re.I), "px"),
    (re.compile(r"\bradians\b", re.I), "rad"),
)
_CHOICES = (
    (re.compile(r"\blistCameras\b"), "string", "cameras"),
    (re.compile(r"\bgetObjects\b|\bName of the object\b"), "string", "objects"),
    (re.compile(r"\bWhich robot of the world\b"), "string", "robots"),
    (re.compile(r"\bforward, back, left, right, up or down\b"), "string", "directions"),
    (re.compile(r"\bDegrees by joint name\b"), "object", "joints"),
)
"""What a parameter's description says of its values: the page lets them be chosen."""

_TYPES = {float: "number", int: "integer", bool: "boolean", str: "string", dict: "object", list: "array"}


def forms_of(functions: Iterable[Mapping[str, Any]]) -> tuple[dict[str, Any], ...]:
    """Return the forms of a device's functions, as it describes them on the network."""
    forms = []
    for each in list(functions)[:FORMS_MAX]:
        schema = each.get("parameters")
        schema = schema if isinstance(schema, Mapping) else {}
        properties, required = schema.get("properties"), schema.get("required")
        labels = each.get("labels")
        reads = isinstance(labels, Mapping) and labels.get("direction") == "read"
        rows = properties.items() if isinstance(properties, Mapping) else ()
        needed = required if isinstance(required, list) else []
        parameters = [_field(name, schema, name in needed) for name, schema in rows if isinstance(schema, Mapping)]
        forms.append(_form(each.get("name"), "read" if reads else "motion", each.get("description"), parameters))
    return tuple(form for form in forms if form["name"] not in LEFT_OUT)


def peer_forms(verbs: Iterable[Verb] = tuple(PEER_VERBS.values())) -> tuple[dict[str, Any], ...]:
    """Return the forms of a mesh peer, which has the same verbs as every other."""
    forms = []
    for verb in verbs:
        parameters = [
            _field(
                each.name,
                {
                    "type": _TYPES.get(each.type, "string"),
                    "description": each.meaning,
                    **({} if each.default is REQUIRED else {"default": each.default}),
                },
                each.default is REQUIRED,
            )
            for each in verb.parameters
        ]
        kind = "read" if verb.kind is Kind.READ else "motion"
        forms.append(_form(verb.name, kind, verb.summary, parameters))
    return tuple(form for form in forms if form["name"] not in LEFT_OUT)


def _form(name: object, kind: str, summary: object, parameters: list[dict[str, Any]]) -> dict[str, Any]:
    given = [each for each in parameters if each["name"] not in LEASE_NAMES][:PARAMETERS_MAX]
    told = str(summary or "").strip().partition("\n")[0][:TEXT_MAX]
    verb = str(name or "")[:100]
    needed = [each["name"] for each in given if each["required"]]
    others = [each["name"] for each in given if not each["required"]]
    usual = (*needed, *others[: max(0, SHOWN_AT_LEAST - len(needed))])
    shown = SHOWN[verb] if set(SHOWN.get(verb, ())) & {each["name"] for each in given} else usual
    fields = [{**each, "shown": each["name"] in shown} for each in given]
    return {"name": verb, "kind": kind, "summary": told, "parameters": fields}


def _field(name: object, schema: Mapping[str, Any], required: bool) -> dict[str, Any]:
    default = schema.get("default")
    if not isinstance(default, str | int | float | bool) or (isinstance(default, float) and not isfinite(default)):
        default = None
    elif isinstance(default, str):
        default = default[:TEXT_MAX]
    meaning, kind = str(schema.get("description", ""))[:TEXT_MAX], str(schema.get("type", "string"))[:20]
    unit = next((unit for words, unit in _UNITS if words.search(meaning)), "") if kind in ("number", "integer") else ""
    return {
        "name": str(name)[:100],
        "type": kind,
        "meaning": meaning,
        "unit": unit,
        "choices": next((of for words, wanted, of in _CHOICES if kind == wanted and words.search(meaning)), ""),
        "default": default,
        "required": required,
    }
