"""Parameters of a verb by their type hints: check and JSON Schema."""

from __future__ import annotations

import inspect
import json
import math
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from strands_robots.safety.gate import Permit
from strands_robots.utils import (
    ValidationError,
    finite,
    flag,
    integral,
    mapping,
    number,
    plain_text,
    plain_value,
    shown,
    text,
)

TEXT_MAX = 2000
"""Characters of a text argument."""

ITEMS_MAX = 1000
"""Items of a list, or keys of a mapping."""

DEPTH_MAX = 8
"""Levels of a parameter's schema."""

MEANING_MAX = 600
UNIT_MAX = 32

Check = Callable[[str, object], Any]

JSON_TYPES: Mapping[type, str] = {
    bool: "boolean",
    int: "integer",
    float: "number",
    str: "string",
    list: "array",
    dict: "object",
}
"""Types of JSON Schema by the types of parameters."""


@dataclass(frozen=True)
class Domain:
    """Domain of a number: bounds that it may have, and its unit.

    Args:
        low: smallest value; None for no bound.
        high: largest value; None for no bound.
        unit: in which it is given, such as ``m``, ``deg`` or ``s``.

    Raises:
        ValidationError: a bound that is no finite number, bounds in the wrong order, or a unit that is no short text.
    """

    low: float | None = None
    high: float | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        for name, bound in (("low", self.low), ("high", self.high)):
            if bound is not None:
                number(name, bound)
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValidationError(f"low must be at most high, not {shown(self.low)} and {shown(self.high)}.")
        text("unit", self.unit, longest=UNIT_MAX, empty=True)

    def schema(self) -> dict[str, Any]:
        """Return its part of a JSON Schema."""
        stated = {"minimum": self.low, "maximum": self.high, "unit": self.unit}
        return {name: value for name, value in stated.items() if value not in (None, "")}


REQUIRED: Any = object()
"""Stands for the default of a parameter that has none."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a verb.

    Attributes:
        meaning: a line for callers, with the unit and the domain.
        type: the Python type that its schema is made from.
        check: gives the value that is used, or raises :class:`ValidationError` naming parameter, value and domain.
        schema: JSON Schema of a robot's own verb, with ``unit`` besides; the others have that of their type.
    """

    name: str
    type: type
    meaning: str
    check: Check
    default: Any = REQUIRED
    schema: Mapping[str, Any] | None = None


def checked_arguments(
    parameters: Mapping[str, Parameter], given: Mapping[str, object], unfit: Callable[[list[str], list[str]], str]
) -> dict[str, Any]:
    """Return the given arguments in their domains.

    Args:
        parameters: by name.
        given: unchecked.
        unfit: returns the refusal for the names that no parameter has, and those of parameters that are missing.

    Raises:
        ValidationError: naming what is unknown, missing, or the first one outside its domain.
    """
    if not given.keys() <= parameters.keys() or len(given) < len(parameters):
        unknown = [name for name in given if name not in parameters]
        missing = [name for name, each in parameters.items() if each.default is REQUIRED and name not in given]
        if unknown or missing:
            raise ValidationError(unfit(unknown, missing))
    return {name: each.check(name, given[name]) for name, each in parameters.items() if name in given}


@dataclass(frozen=True)
class _Kind:
    type: type
    check: Check
    schema: dict[str, Any] = field(default_factory=dict)


def is_permit(hint: Any) -> bool:
    """Return True for the type of a permit, annotated or not."""
    return hint is Permit or (get_origin(hint) is Annotated and get_args(hint)[0] is Permit)


def parameter_of(where: str, parameter: inspect.Parameter, hint: Any, meaning: str) -> Parameter:
    """Return a parameter by its hint.

    Args:
        where: what messages call it.
        parameter: of the signature.
        hint: bool, int, float, str, a ``Literal``, a list or dict of those, each perhaps ``| None``; ``Annotated`` with
            a :class:`Domain` and a text that says what it means.
        meaning: of the docstring.

    Raises:
        ValidationError: no hint, another one, or a default outside the domain.
    """
    if hint is None or hint is inspect.Parameter.empty:
        raise ValidationError(f"{where} needs a type hint: a caller has to know what to give.")
    stated = [each for each in get_args(hint)[1:] if isinstance(each, str)] if get_origin(hint) is Annotated else []
    kind = _kind(where, hint, None, DEPTH_MAX)
    required = parameter.default is inspect.Parameter.empty
    schema, default = dict(kind.schema), REQUIRED
    if not required:
        default = parameter.default
        if default is not None:
            try:
                default = kind.check(parameter.name, default)
                json.dumps(default, allow_nan=False)
            except (ValidationError, TypeError, ValueError, RecursionError) as exc:
                raise ValidationError(f"The default of {where} is outside its domain: {exc}") from None
            schema["default"] = default
    words = plain_text(meaning or " ".join(stated), MEANING_MAX)
    described = {**schema, "description": words} if words else schema
    check = kind.check if required or parameter.default is not None else _or_none(kind.check)
    return Parameter(parameter.name, kind.type, words, check, default, described)


def _kind(where: str, hint: Any, domain: Domain | None, depth: int) -> _Kind:
    if depth == 0:
        raise ValidationError(f"{where} is nested deeper than {DEPTH_MAX} levels.")
    origin, inside = get_origin(hint), get_args(hint)
    if origin is Annotated:
        domains = [each for each in inside[1:] if isinstance(each, Domain)]
        if len(domains) > 1:
            raise ValidationError(f"{where} has more than one Domain.")
        return _kind(where, inside[0], domains[0] if domains else domain, depth)
    some = [each for each in inside if each is not type(None)]
    if origin in (Union, types.UnionType) and len(some) == 1 and len(inside) == 2:
        kind = _kind(where, some[0], domain, depth)
        return _Kind(kind.type, _or_none(kind.check), kind.schema)
    if hint is list or origin is list:
        return _list(_kind(f"an item of {where}", inside[0], domain, depth - 1) if inside else None)
    if hint is dict or origin is dict:
        if inside and inside[0] is not str:
            raise ValidationError(f"{where} must have texts as keys, as every message has, not {shown(inside[0])}.")
        return _mapping(_kind(f"a value of {where}", inside[1], domain, depth - 1) if inside else None)
    return _scalar(where, hint, domain)


def _scalar(where: str, hint: Any, domain: Domain | None) -> _Kind:
    if hint in (int, float):
        return _number(hint, domain or Domain())
    if domain is not None:
        raise ValidationError(f"{where} has a Domain, which is of numbers only.")
    if get_origin(hint) is Literal:
        return _choice(where, get_args(hint))
    if hint is bool:
        return _Kind(bool, flag, {"type": "boolean"})
    if hint is str:
        check: Check = lambda name, value: text(name, value, longest=TEXT_MAX, empty=True)  # noqa: E731 - one line
        return _Kind(str, check, {"type": "string", "maxLength": TEXT_MAX})
    allowed = "bool, int, float, str, Literal, or a list or dict of those, perhaps | None"
    raise ValidationError(f"{where} must be {allowed}, not {shown(hint)}.")


def _number(hint: type, domain: Domain) -> _Kind:
    if hint is float:
        return _Kind(
            float,
            lambda name, value: number(name, value, low=domain.low, high=domain.high),
            {"type": "number", **domain.schema()},
        )
    low = None if domain.low is None else math.ceil(domain.low)
    high = None if domain.high is None else math.floor(domain.high)
    return _Kind(
        int,
        lambda name, value: integral(name, value, low=low, high=high),
        {"type": "integer", **Domain(low, high, domain.unit).schema()},
    )


def _choice(where: str, values: tuple[Any, ...]) -> _Kind:
    kinds = {type(each) for each in values}
    kind = kinds.pop() if len(kinds) == 1 else None
    if kind not in (bool, int, float, str):
        raise ValidationError(f"{where} must be a Literal of texts, of numbers or of booleans alone.")

    def check(name: str, value: object) -> Any:
        plain = plain_value(value)
        if kind is int and isinstance(plain, float) and plain.is_integer():
            plain = int(plain)
        if type(plain) is not kind or plain not in values:
            allowed = ", ".join(str(each) for each in values)
            raise ValidationError(f"{name} must be one of {allowed}, not {shown(value)}.")
        return plain

    return _Kind(kind, check, {"type": JSON_TYPES[kind], "enum": list(values)})


def _list(item: _Kind | None) -> _Kind:
    def check(name: str, value: object) -> list[Any]:
        plain = plain_value(value)
        if not isinstance(plain, list | tuple) or len(plain) > ITEMS_MAX:
            raise ValidationError(f"{name} must be a list of at most {ITEMS_MAX} items, not {shown(value)}.")
        if item is None:
            finite(name, plain)
            return list(plain)
        return [item.check(f"{name}[{at}]", each) for at, each in enumerate(plain)]

    return _Kind(
        list, check, {"type": "array", "maxItems": ITEMS_MAX, **({} if item is None else {"items": item.schema})}
    )


def _mapping(entry: _Kind | None) -> _Kind:
    def check(name: str, value: object) -> dict[str, Any]:
        given = mapping(name, value)
        if len(given) > ITEMS_MAX:
            raise ValidationError(f"{name} must have at most {ITEMS_MAX} keys, not {len(given)}.")
        if entry is None:
            finite(name, given)
            return given
        return {key: entry.check(f"{name}[{shown(key)}]", each) for key, each in given.items()}

    values = {} if entry is None else {"additionalProperties": entry.schema}
    return _Kind(dict, check, {"type": "object", **values})


def _or_none(check: Check) -> Check:
    return lambda name, value: None if value is None else check(name, value)
