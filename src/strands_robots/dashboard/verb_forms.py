"""Forms of a robot's verbs, made from its descriptions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any

from strands_robots.serving.advertised import AdvertisedParameter, AdvertisedVerb, RobotDescription
from strands_robots.serving.control_leases import CONTROL_VERBS

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

_NUMBERS = ("number", "integer")


def forms_of(functions: Iterable[Mapping[str, Any]]) -> tuple[dict[str, Any], ...]:
    """Return the forms of a robot's functions, as it describes them on its network."""
    return forms_of_verbs(RobotDescription.of(list(functions)).verbs.values())


def forms_of_verbs(verbs: Iterable[AdvertisedVerb]) -> tuple[dict[str, Any], ...]:
    """Return the forms of a robot's verbs."""
    return tuple(_form(each) for each in islice((each for each in verbs if each.name not in LEFT_OUT), FORMS_MAX))


def _form(verb: AdvertisedVerb) -> dict[str, Any]:
    needed = [each.name for each in verb.parameters if each.required]
    others = [each.name for each in verb.parameters if not each.required]
    usual = (*needed, *others[: max(0, SHOWN_AT_LEAST - len(needed))])
    shown = SHOWN[verb.name] if set(SHOWN.get(verb.name, ())) & {*needed, *others} else usual
    return {
        "name": verb.name,
        "kind": "read" if verb.reads else "motion",
        "own": verb.own,
        "lasts_s": verb.lasts_s,
        "summary": verb.summary[:TEXT_MAX],
        "parameters": [{**_field(each), "shown": each.name in shown} for each in verb.parameters[:PARAMETERS_MAX]],
    }


def _field(parameter: AdvertisedParameter) -> dict[str, Any]:
    meaning, kind, default = parameter.meaning[:TEXT_MAX], parameter.type or "string", parameter.default
    guessed = next((unit for words, unit in _UNITS if words.search(meaning)), "") if kind in _NUMBERS else ""
    return {
        "name": parameter.name,
        "type": kind,
        "meaning": meaning,
        "unit": parameter.unit or guessed,
        "low": parameter.low,
        "high": parameter.high,
        "enum": list(parameter.choices),
        "choices": next((of for words, wanted, of in _CHOICES if kind == wanted and words.search(meaning)), ""),
        "default": default[:TEXT_MAX] if isinstance(default, str) else default,
        "required": parameter.required,
    }
