"""A robot's verbs as methods: name, signature and docstring in Python."""

from __future__ import annotations

import inspect
import re
from keyword import iskeyword

from strands_robots.serving.advertised import PYTHON_TYPES, AdvertisedParameter, AdvertisedVerb
from strands_robots.utils import shown

MARK = "(as the robot describes it)"


def python_name(name: str) -> str:
    """Return a verb's name on the wire as Python spells it: ``moveTo``, ``move_to``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def signature(verb: AdvertisedVerb) -> inspect.Signature:
    """Return the signature of a verb as a method, required parameters first."""
    named = [each for each in verb.parameters if not iskeyword(each.name)]
    rows = [_parameter(each) for each in sorted(named, key=lambda each: not each.required)]
    return inspect.Signature(rows, return_annotation=dict)


def docstring(verb: AdvertisedVerb, note: str = "") -> str:
    """Return the docstring of a verb as a method, marked as the robot's words."""
    lines = [verb.purpose or verb.name]
    if verb.parameters:
        lines += ["", "Args:", *(f"    {each.name}: {_meaning(each)}" for each in verb.parameters)]
    return "\n".join([*lines, "", *filter(None, [note]), MARK])


def _parameter(parameter: AdvertisedParameter) -> inspect.Parameter:
    empty = inspect.Parameter.empty
    return inspect.Parameter(
        parameter.name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=empty if parameter.required else parameter.schema.get("default"),
        annotation=PYTHON_TYPES.get(parameter.type, empty),
    )


def _meaning(parameter: AdvertisedParameter) -> str:
    """Return the line of one parameter: meaning, unit, domain."""
    unit = f"in {parameter.unit}" if parameter.unit else ""
    choices = f"one of {', '.join(map(shown, parameter.choices))}" if parameter.choices else ""
    said = (" ".join(parameter.meaning.split()), unit, parameter.bounds, choices)
    return "; ".join(filter(None, said)) or "(not described)"
