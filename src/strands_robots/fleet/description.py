"""Verbs as a remote robot describes them, within bounds.

A description is data from the wire. It is copied in bounded time, and what is out of bounds is left out and named:
more than :data:`VERBS_MAX` verbs or :data:`TOTAL_MAX` characters, names that are no identifiers, a schema that nests
deeper than :data:`DEPTH_MAX`. Texts lose control characters, terminal escapes and invisible characters.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from keyword import iskeyword
from types import MappingProxyType
from typing import Any, Literal

from strands_robots.errors import StrandsRobotsError
from strands_robots.serving.verbs import LEASE_NAMES
from strands_robots.utils import DURATION_MAX_S, shown

TOTAL_MAX = 64_000
"""Characters that all verbs of a robot may take together."""

VERB_MAX = 16_000
"""Characters of one verb."""

VERBS_MAX = 500
PARAMETERS_MAX = 100
DEPTH_MAX = 8
"""Levels of a verb's parameters, counted from their JSON Schema."""

NAME_MAX = 100
TEXT_MAX = 2_000
SUMMARY_MAX = 300
LEFT_OUT_MAX = 20
"""Things left out that are named one by one."""

NODE = 8
"""Characters that a value counts besides its text, so that many small ones are bounded too."""

STOPS = ("stop", "stopMotion")
MARK = "(as the robot describes it)"

_ESCAPE = re.compile(
    r"\x1b(?:\[[0-?]*[ -/]*[@-~]|[\]PX^_][^\x07\x1b]*(?:\x07|\x1b\\)?|[ -/]*[0-~])|\x9b[0-?]*[ -/]*[@-~]"
)
_NAME = re.compile(rf"[A-Za-z_][A-Za-z0-9_]{{0,{NAME_MAX - 1}}}\Z")
_TYPES = {"string": str, "number": float, "integer": int, "boolean": bool, "array": list, "object": dict}

VerbKind = Literal["read", "motion", "stop"]


class _OutOfBoundsError(StrandsRobotsError, ValueError):
    """A value that is left out; the text says why."""


@dataclass(frozen=True, slots=True)
class VerbDescription:
    """A verb in the words of its robot.

    Attributes:
        name: on the wire, such as ``moveTo``.
        summary: one line.
        text: the whole description.
        parameters: JSON Schema of the arguments, without those of the control lease.
        kind: ``read``, ``motion`` or ``stop``; what does not say that it reads is a motion.
        own: declared by the robot's author with ``@verb``.
        lasts_s: seconds that it may take until it answers; 0 for a verb that answers soon.
        leased: takes the ``lease_id`` of the caller.
    """

    name: str
    summary: str = ""
    text: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    kind: VerbKind = "motion"
    own: bool = False
    lasts_s: float = 0.0
    leased: bool = False

    @property
    def waits(self) -> bool:
        """True for a verb that answers at the end of its motion, or of a wait."""
        return self.name == "wait" or "wait" in self.parameters.get("properties", {})

    def signature(self) -> inspect.Signature:
        """Return the signature of the verb as a method, required parameters first."""
        properties, required = self.parameters.get("properties", {}), self.parameters.get("required", ())
        named = [name for name in properties if not iskeyword(name)]
        return inspect.Signature(
            [_parameter(name, properties[name], required) for name in sorted(named, key=lambda n: n not in required)],
            return_annotation=dict,
        )

    def docstring(self, note: str = "") -> str:
        """Return the docstring of the verb as a method, marked as the robot's words."""
        lines = [self.text or self.summary or self.name]
        properties = self.parameters.get("properties", {})
        if properties:
            head = self.text.partition("\n\nArgs:")[0].strip()
            lines = [
                head or self.name,
                "",
                "Args:",
                *(f"    {name}: {_meaning(properties[name])}" for name in properties),
            ]
        return "\n".join([*lines, "", *filter(None, [note]), MARK])


@dataclass(frozen=True, slots=True)
class RobotDescription:
    """The verbs of a robot by their names on the wire, and what was left out of them."""

    verbs: Mapping[str, VerbDescription] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, functions: object) -> RobotDescription:
        """Read the functions that a robot announces; never raises."""
        if not isinstance(functions, Sequence) or isinstance(functions, str | bytes):
            return cls(left_out=() if functions is None else (f"its verbs, which are no list: {quoted(functions)}",))
        verbs: dict[str, VerbDescription] = {}
        left_out = _LeftOut()
        left = TOTAL_MAX
        for function in islice(functions, VERBS_MAX):
            share = min(left, VERB_MAX)
            reader = _Reader(share, left_out)
            try:
                verb = reader.verb(function)
            except _OutOfBoundsError as exc:
                left_out.add(str(exc))
            else:
                if verbs.setdefault(verb.name, verb) is not verb:
                    left_out.add(f"a second verb {verb.name}")
            # What was looked at in vain counts as well, which bounds the time.
            left -= share - max(reader.left, 0)
        if len(functions) > VERBS_MAX:
            left_out.add(f"{len(functions) - VERBS_MAX} verbs after the first {VERBS_MAX}")
        return cls(MappingProxyType(verbs), left_out.named())


def python_name(name: str) -> str:
    """Return a verb's name on the wire as Python spells it: ``moveTo``, ``move_to``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def plain_text(value: object, longest: int = TEXT_MAX, *, lines: bool = False) -> str:
    """Return a text of a robot without what a terminal would act on; "" for no text.

    Args:
        value: the text as it came.
        longest: characters after which it is cut.
        lines: keep line ends; else they become spaces.
    """
    if not isinstance(value, str):
        return ""
    cut = _ESCAPE.sub("", value[: 2 * longest])
    spaced = "".join(" " if char.isspace() and char != "\n" else char for char in cut)
    kept = "".join(char for char in spaced if char.isprintable() or char == "\n")
    shortened = kept if len(kept) <= longest and len(value) <= 2 * longest else f"{kept[: longest - 3]}..."
    return shortened.strip() if lines else " ".join(shortened.split())


def quoted(value: object) -> str:
    """Return a short repr of a foreign value."""
    return plain_text(shown(value), 120)


class _LeftOut:
    """Names of what was left out; the first :data:`LEFT_OUT_MAX` of them."""

    def __init__(self) -> None:
        self._named: list[str] = []
        self._more = 0

    def add(self, what: str) -> None:
        if len(self._named) < LEFT_OUT_MAX:
            self._named.append(what)
        else:
            self._more += 1

    def named(self) -> tuple[str, ...]:
        return (*self._named, f"{self._more} more") if self._more else tuple(self._named)


class _Reader:
    """Copies one verb of a description within its share of characters."""

    def __init__(self, left: int, left_out: _LeftOut) -> None:
        self.left = left
        self._left_out = left_out

    def verb(self, function: object) -> VerbDescription:
        name = function.get("name") if isinstance(function, Mapping) else None
        if not isinstance(function, Mapping) or not isinstance(name, str) or not _NAME.match(name):
            raise _OutOfBoundsError(f"a verb whose name is no identifier of at most {NAME_MAX} letters: {quoted(name)}")
        self._take(len(name), name)
        text = self._text(function.get("description"), name)
        labels = function.get("labels")
        labels = labels if isinstance(labels, Mapping) else {}
        kind: VerbKind = "read" if labels.get("direction") == "read" else "motion"
        properties, required, leased = self._parameters(name, function.get("parameters"))
        return VerbDescription(
            name=name,
            summary=plain_text(text.partition("\n\n")[0], SUMMARY_MAX),
            text=text,
            parameters={"type": "object", "properties": properties, "required": required},
            kind="stop" if name in STOPS else kind,
            own=labels.get("own") in ("true", True),
            lasts_s=_seconds(labels.get("lasts_s")),
            leased=leased,
        )

    def _parameters(self, verb: str, schema: object) -> tuple[dict[str, Any], list[str], bool]:
        stated = schema.get("properties") if isinstance(schema, Mapping) else None
        demanded = schema.get("required") if isinstance(schema, Mapping) else None
        if not isinstance(stated, Mapping):
            return {}, [], False
        leased = "lease_id" in stated and "lease_ttl_s" in stated
        properties: dict[str, Any] = {}
        for name, value in islice(stated.items(), PARAMETERS_MAX):
            if leased and name in LEASE_NAMES:
                continue
            if not isinstance(name, str) or not _NAME.match(name):
                self._left_out.add(f"parameter {quoted(name)} of {verb}, whose name is no identifier")
                continue
            try:
                self._take(len(name), verb)
                # Its schema stands on the third level: parameters, properties, parameter.
                properties[name] = self._copy(value if isinstance(value, Mapping) else {}, verb, name, 3)
            except _OutOfBoundsError as exc:
                self._left_out.add(str(exc))
        if len(stated) > PARAMETERS_MAX:
            self._left_out.add(f"{len(stated) - PARAMETERS_MAX} parameters of {verb}")
        needed = demanded if isinstance(demanded, Sequence) and not isinstance(demanded, str) else ()
        asked = [name for name in islice(needed, 2 * PARAMETERS_MAX) if isinstance(name, str)]
        return properties, [name for name in properties if name in asked], leased

    def _copy(self, value: object, verb: str, parameter: str, level: int) -> Any:
        self._take(NODE, verb)
        if isinstance(value, Mapping | list | tuple) and level > DEPTH_MAX:
            raise _OutOfBoundsError(f"parameter {parameter} of {verb}, nested deeper than {DEPTH_MAX}")
        if isinstance(value, Mapping):
            copied = {}
            for key, item in value.items():
                name = self._text(key, verb, NAME_MAX)
                copied[name] = self._copy(item, verb, parameter, level + 1)
            return copied
        if isinstance(value, list | tuple):
            return [self._copy(item, verb, parameter, level + 1) for item in value]
        if isinstance(value, str):
            return self._text(value, verb)
        if isinstance(value, bool) or value is None:
            return value
        if isinstance(value, int) and value.bit_length() <= 64:
            return value
        return value if isinstance(value, float) and math.isfinite(value) else None

    def _text(self, value: object, verb: str, longest: int = TEXT_MAX) -> str:
        self._take(min(len(value), 2 * longest) if isinstance(value, str) else 0, verb)
        return plain_text(value, longest, lines=True)

    def _take(self, characters: int, verb: str) -> None:
        self.left -= characters
        if self.left < 0:
            raise _OutOfBoundsError(f"{verb}, or a part of it, which is too long")


def _seconds(label: object) -> float:
    """Return the seconds of a label, 0 for what is none."""
    try:
        seconds = float(label) if isinstance(label, str | int | float) and len(str(label)) <= 20 else 0.0
    except (ValueError, OverflowError):
        return 0.0
    return seconds if 0.0 <= seconds <= DURATION_MAX_S else 0.0


def _parameter(name: str, schema: Mapping[str, Any], required: Sequence[str]) -> inspect.Parameter:
    empty, stated = inspect.Parameter.empty, schema.get("type")
    return inspect.Parameter(
        name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=empty if name in required else schema.get("default"),
        annotation=_TYPES.get(stated, empty) if isinstance(stated, str) else empty,
    )


def _meaning(schema: Mapping[str, Any]) -> str:
    """Return the line of one parameter: meaning, unit, domain."""
    said = schema.get("description")
    meaning = plain_text(said) if isinstance(said, str) else ""
    return "; ".join(filter(None, [meaning, *_domain(schema)])) or "(not described)"


def _domain(schema: Mapping[str, Any]) -> Iterator[str]:
    unit, low, high, choices = (schema.get(key) for key in ("unit", "minimum", "maximum", "enum"))
    if isinstance(unit, str) and unit:
        yield f"in {plain_text(unit, 40)}"
    if low is not None and high is not None:
        yield f"{quoted(low)} to {quoted(high)}"
    elif low is not None or high is not None:
        yield f"at least {quoted(low)}" if high is None else f"at most {quoted(high)}"
    if isinstance(choices, list):
        yield f"one of {', '.join(quoted(each) for each in choices[:20])}"
