"""Verbs as a robot advertises them, read from its description within bounds.

A description is data of its robot. Whatever it holds, nothing raises here, texts are plain, and the work is bounded.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from math import isfinite
from typing import Any, TypeAlias, TypeVar

from strands_robots.serving.verbs import LEASE_NAMES
from strands_robots.utils import ValidationError, shown

VERBS_MAX, PARAMETERS_MAX, CHOICES_MAX = 1000, 64, 64
"""Verbs of a robot, parameters of a verb and values of a choice that are read."""

NAME_MAX, UNIT_MAX, TEXT_MAX = 100, 20, 2000

DEPTH_MAX, NODES_MAX = 8, 500
"""Nesting of a verb's schema, and values of one parameter's, that are read."""

WHOLE_MAX = 2**63
"""Bound of a whole number; Python takes the square of the digits' number to write one."""

LASTS_MAX_S = 3600.0

NEAR_MAX, NAMED_MAX = 64, 40
"""Letters of a name that are compared for likeness, and names that a sentence lists."""

T = TypeVar("T")
Scalar: TypeAlias = str | int | float | bool

_LOCK = "resume"
"""Verb of each robot that an emergency stop locks: a device without it has its functions alone."""


@dataclass(frozen=True, slots=True)
class AdvertisedParameter:
    """One parameter of a verb, as its robot describes it.

    Attributes:
        type: of JSON Schema; empty where it is stated in another way than by one name.
        default: a scalar, or None.
        low: its lower bound, or None; ``high`` the upper one.
        choices: the values that it may have; empty for any.
        schema: all that the robot says of it, within bounds.
    """

    name: str
    type: str
    meaning: str
    required: bool
    default: Scalar | None
    low: float | None
    high: float | None
    choices: tuple[Scalar, ...]
    unit: str
    schema: Mapping[str, Any]

    @property
    def domain(self) -> str:
        """Values that it may have, as in ``integer, 1 to 8 cups`` or ``mild | strong``."""
        if self.choices:
            return " | ".join(each if isinstance(each, str) else json.dumps(each) for each in self.choices)
        kind, bounds = self.type or "any", self._bounds
        measured = " ".join(filter(None, (bounds, self.unit)))
        return f"{kind}, {measured}" if measured else kind

    def problem(self, value: object) -> str:
        """Return why a value of the right type does not fit, or nothing."""
        # True is 1 to Python, and is not to a robot.
        kind = isinstance(value, bool)
        if self.choices and not any(each == value and isinstance(each, bool) is kind for each in self.choices):
            return f"{self.name} must be one of {', '.join(map(str, self.choices))}, not {shown(value)}."
        if isinstance(value, int | float) and not kind:
            outside = (self.low is not None and value < self.low) or (self.high is not None and value > self.high)
            if outside:
                return f"{self.name} must be {self._bounds}{f' {self.unit}' if self.unit else ''}, not {shown(value)}."
        return ""

    @property
    def _bounds(self) -> str:
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        if self.low is not None:
            return f"at least {self.low:g}"
        return "" if self.high is None else f"at most {self.high:g}"


@dataclass(frozen=True, slots=True)
class AdvertisedVerb:
    """One verb, as its robot describes it.

    Attributes:
        description: in plain lines; ``summary`` is its first one.
        parameters: without those of the lease, which ``leases`` names.
        leases: the parameters of the lease that it takes.
        reads: it is declared a read; anything else counts as a motion.
        own: it is declared one of the robot's own, or the robot is none of ours.
        lasts_s: seconds that it may take before it answers.
        stated: its parameters are stated; else it may take any.
    """

    name: str
    description: str
    parameters: tuple[AdvertisedParameter, ...]
    leases: frozenset[str]
    reads: bool
    own: bool
    lasts_s: float
    stated: bool

    @property
    def summary(self) -> str:
        """The first line of its description."""
        return self.description.partition("\n")[0]

    @property
    def by_name(self) -> dict[str, AdvertisedParameter]:
        """Its parameters by name."""
        return {each.name: each for each in self.parameters}

    @property
    def takes(self) -> str:
        """Its parameters in one line, those that may be left out in brackets."""
        named = (f"{each.name}: {each.domain}" for each in self.parameters)
        rows = (text if each.required else f"[{text}]" for each, text in zip(self.parameters, named, strict=True))
        return "; ".join(rows)

    def schema(self) -> dict[str, Any]:
        """Return the JSON Schema of its parameters."""
        properties = {each.name: dict(each.schema) for each in self.parameters}
        required = [each.name for each in self.parameters if each.required]
        return {"type": "object", "properties": properties, **({"required": required} if required else {})}

    def unknown(self, names: Iterable[str]) -> str:
        """Return the refusal of arguments that it does not have, or nothing."""
        known = [each.name for each in self.parameters]
        absent = [shown(name) for name in names if name in LEASE_NAMES or (self.stated and name not in known)]
        if not absent:
            return ""
        return f"{self.name} takes no argument {', '.join(absent[:3])}; its arguments: {', '.join(known) or 'none'}."


def verbs_of(functions: object, most: int = VERBS_MAX) -> list[AdvertisedVerb]:
    """Return a robot's verbs, each name once; what is no description is left out."""
    own = _LOCK not in verb_names(functions)
    return list({each["name"]: _verb(each, own) for each in islice(_rows(functions), most)}.values())


def find_verb(functions: object, name: str) -> AdvertisedVerb | None:
    """Return the verb of a name, or None."""
    named = next((each for each in _rows(functions) if each["name"] == name), None)
    return None if named is None else _verb(named, _LOCK not in verb_names(functions))


def verb_names(functions: object) -> list[str]:
    """Return the names of a robot's verbs."""
    return [each["name"] for each in _rows(functions)]


def own_names(names: object) -> list[str]:
    """Return the names of own verbs as a mesh peer's presence has them."""
    return verb_names([{"name": each} for each in islice(names, VERBS_MAX)]) if isinstance(names, list) else []


def absent_safety(functions: object) -> str:
    """Return a sentence on what a device lacks to be stopped and held, or nothing.

    A device that is none of ours has its functions alone.
    """
    names = set(verb_names(functions))
    has = {"lock": {_LOCK}, "lease": {"acquireControl"}, "stop": {"stop", "stopMotion"}}
    lacks = [f"no {what}" for what, verbs in has.items() if not verbs & names]
    if not lacks:
        return ""
    said = lacks[0] if len(lacks) == 1 else f"{', '.join(lacks[:-1])} and {lacks[-1]}"
    return f"This device has {said}."


def near(wanted: str, names: Iterable[str]) -> str:
    """Return a sentence with the names that resemble ``wanted``, else with all."""
    import difflib  # noqa: PLC0415 - only a name that is not there needs it

    known = sorted(name for name in islice(names, VERBS_MAX) if len(name) <= NEAR_MAX)
    alike = difflib.get_close_matches(wanted[:NEAR_MAX], known, n=3, cutoff=0.5)
    if alike:
        return f" Near it: {', '.join(alike)}."
    more = f" and {len(known) - NAMED_MAX} more" if len(known) > NAMED_MAX else ""
    return f" There {'is' if len(known) == 1 else 'are'}: {', '.join(known[:NAMED_MAX])}{more}." if known else ""


def fitting(rows: Iterable[T], most: int) -> list[T]:
    """Return the rows whose JSON is within so many bytes together, the first ones first."""
    kept, left = list[T](), most
    for each in rows:
        size = len(json.dumps(each)) + 2
        if size <= left:
            left -= size
            kept.append(each)
    return kept


def plain_text(value: object, longest: int = TEXT_MAX) -> str:
    """Return a text's printable characters and line breaks, cut; else an empty text."""
    if not isinstance(value, str):
        return ""
    cut = value[:longest]
    return "".join(char for char in cut if char.isprintable() or char == "\n").strip()


def plain_data(value: object, depth: int = DEPTH_MAX - 2, nodes: int = NODES_MAX) -> Any:
    """Return a value as JSON can carry it, with plain texts and within the bounds."""
    left = [nodes]

    def copied(each: object, deep: int) -> Any:
        left[0] -= 1
        if isinstance(each, str):
            return plain_text(each)
        if isinstance(each, Mapping | list | tuple):
            if deep == 0:
                return None
            if isinstance(each, Mapping):
                rows = islice(each.items(), max(0, left[0]))
                return {
                    plain_text(name, NAME_MAX): copied(one, deep - 1)
                    for name, one in rows
                    if isinstance(name, str) and left[0] > 0
                }
            return [copied(one, deep - 1) for one in islice(each, max(0, left[0])) if left[0] > 0]
        return _scalar(each)

    return copied(value, depth)


def typed(parameter: AdvertisedParameter, value: object, text: str) -> Any:
    """Return a value of the command line as its parameter's type has it.

    Args:
        parameter: as the robot describes it.
        value: ``text`` as JSON where it is some, else the text.
        text: as it was typed.

    Raises:
        ValidationError: it does not fit.
    """
    wanted = parameter.type
    if wanted == "string" and not (isinstance(value, str) and text[:1] == '"'):
        value = text
    elif value is not None and wanted in _TYPES:
        kinds, word = _TYPES[wanted]
        if not isinstance(value, kinds) or (isinstance(value, bool) and wanted != "boolean"):
            raise ValidationError(f"{parameter.name} must be {word}, not {shown(text)}.")
    problem = parameter.problem(value) if value is not None else ""
    if problem:
        raise ValidationError(problem)
    return value


_TYPES: dict[str, tuple[type | tuple[type, ...], str]] = {
    "integer": (int, "a whole number"),
    "number": ((int, float), "a number"),
    "boolean": (bool, "true or false"),
    "array": (list, "a list as JSON"),
    "object": (dict, "an object as JSON"),
}


def _rows(functions: object) -> Iterator[Mapping[str, Any]]:
    """Yield the descriptions that have a name of printable characters, as a verb has."""
    for each in functions if isinstance(functions, list | tuple) else ():
        name = each.get("name") if isinstance(each, Mapping) else None
        if isinstance(name, str) and 0 < len(name) <= NAME_MAX and name.isprintable():
            yield each


def _verb(function: Mapping[str, Any], own: bool) -> AdvertisedVerb:
    schema, labels = _object(function, "parameters"), _object(function, "labels")
    required = schema.get("required")
    needed = set(_texts(required)) if isinstance(required, list) else set()
    rows = [
        (name, each)
        for name, each in islice(_object(schema, "properties").items(), PARAMETERS_MAX + len(LEASE_NAMES))
        if isinstance(name, str) and 0 < len(name) <= NAME_MAX and name.isprintable() and isinstance(each, Mapping)
    ]
    given = [_parameter(name, each, name in needed) for name, each in rows if name not in LEASE_NAMES]
    return AdvertisedVerb(
        name=function["name"],
        description=plain_text(function.get("description")),
        parameters=tuple(given[:PARAMETERS_MAX]),
        leases=LEASE_NAMES & {name for name, _ in rows},
        reads=labels.get("direction") == "read",
        own=own or labels.get("own") == "true",
        lasts_s=_seconds(labels.get("lasts_s")),
        stated=isinstance(schema.get("properties"), Mapping),
    )


def _parameter(name: str, schema: Mapping[str, Any], required: bool) -> AdvertisedParameter:
    kind, choices, default = schema.get("type"), schema.get("enum"), schema.get("default")
    kinds = [each for each in _texts(kind if isinstance(kind, list) else [kind]) if each != "null"]
    values = islice(choices, CHOICES_MAX) if isinstance(choices, list | tuple) else ()
    return AdvertisedParameter(
        name=name,
        type=kinds[0][:UNIT_MAX] if len(kinds) == 1 and kinds[0].isalpha() else "",
        meaning=plain_text(schema.get("description")),
        required=required,
        default=_scalar(default),
        low=_number(schema.get("minimum")),
        high=_number(schema.get("maximum")),
        choices=tuple(each for each in map(_scalar, values) if each is not None),
        unit=plain_text(schema.get("unit"), UNIT_MAX).replace("\n", " "),
        schema=plain_data(schema),
    )


def _object(holder: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = holder.get(name)
    return value if isinstance(value, Mapping) else {}


def _texts(values: Iterable[object]) -> Iterator[str]:
    return (each for each in islice(values, PARAMETERS_MAX * 2) if isinstance(each, str))


def _scalar(value: object) -> Scalar | None:
    if isinstance(value, str):
        return plain_text(value)
    if isinstance(value, bool):
        return value
    if isinstance(value, int):
        return value if abs(value) < WHOLE_MAX else None
    return value if isinstance(value, float) and isfinite(value) else None


def _number(value: object) -> float | None:
    found = _scalar(value)
    return found if isinstance(found, int | float) and not isinstance(found, bool) else None


def _seconds(label: object) -> float:
    if not isinstance(label, str) or len(label) > UNIT_MAX:
        return 0.0
    try:
        seconds = float(label)
    except ValueError:
        return 0.0
    return min(max(seconds, 0.0), LASTS_MAX_S) if isfinite(seconds) else 0.0
