"""Verbs as a robot advertises them, read within bounds, and the names of ours.

A description is data of its robot. Whatever it holds, nothing raises here, the work is bounded, and texts lose control
characters, terminal escapes and invisible characters. What is out of bounds is left out and named: more than
:data:`VERBS_MAX` verbs or :data:`TOTAL_MAX` characters, names that are no identifiers, a schema that nests deeper than
:data:`DEPTH_MAX`.

The names of our robots' verbs are here for callers that need no more of them than that: their tables are slow to load.
``tests/serving/test_known_verbs.py`` holds them to those tables. No verb of a robot's own has one of these names.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from math import isfinite
from types import MappingProxyType
from typing import Any, Literal, TypeAlias, TypeVar

from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import DURATION_MAX_S, ValidationError, integral, number, plain_text, shown
from strands_robots.verb_parameters import JSON_TYPES, UNIT_MAX

READS = frozenset(
    {
        *("describe", "features", "ping", "state", "status", "teleop_status", "teleop_stop"),
        *("getControl", "getDaemonStatus", "getFeatures", "getImu", "getJoints", "getObjects", "getPicture", "getPose"),
        *("getState", "getStatus", "listCameras", "listMoves"),
    }
)
"""Reads that are answered at once."""

STOPS = frozenset({"stop", "stopMotion"})

RESUMES = frozenset({"resume", "renewControl", "releaseControl", "takeControl", "leadTo"})
"""Verbs that need the secret of what was begun before, or a signature, and begin nothing."""

QUICK = READS | STOPS | RESUMES
"""Verbs that are answered at once and start no motion."""

WAITING = frozenset({"goTo", "moveBy", "moveJoints", "moveTo", "pick", "place", "setGripper", "wait"})
"""Verbs that may wait for the end of a motion."""

STARTING = frozenset(
    {
        *("acquireControl", "antennas", "body", "disableMotors", "drive", "enableMotors", "execute", "happy", "lead"),
        *(
            "look",
            "navigateTo",
            "nod",
            "playMove",
            "releaseTorque",
            "reset",
            "savePlace",
            "shake",
            "sleep",
            "start",
            "step",
        ),
        *("teleop_receive", "wakeUp"),
    }
)
"""Motions that are only started, and what is asked for as one."""

VERBS = QUICK | WAITING | STARTING

TEXTS = frozenset(
    {
        *("camera", "device_name", "direction", "frame_id", "guide", "instruction", "kind", "lead_id"),
        *("leader", "lease_id", "library", "motor_ids"),
        *("move_name", "nonce", "object", "on", "picture", "place", "policy_host", "policy_provider"),
        *("pretrained_name_or_path", "reason", "robot_name", "source_peer_id", "task_id"),
    }
)
"""Parameters of those verbs that are texts; every other one is none."""


TOTAL_MAX, VERB_MAX = 64_000, 16_000
"""Characters that all verbs of a robot may take together, and those of one verb."""

VERBS_MAX, PARAMETERS_MAX, CHOICES_MAX = 500, 64, 64
"""Verbs of a robot, parameters of a verb and values of a choice that are read."""

DEPTH_MAX = 8
"""Levels of a verb's parameters, counted from their JSON Schema."""

NAME_MAX, TEXT_MAX = 100, 2_000

LEFT_OUT_MAX = 20
"""Things left out that are named one by one."""

NODE = 8
"""Characters that a value counts besides its text, so that many small ones are bounded too."""

WHOLE_MAX = 2**63
"""Bound of a whole number; Python takes the square of the digits' number to write one."""


T = TypeVar("T")
Scalar: TypeAlias = str | int | float | bool
VerbKind = Literal["read", "motion", "stop"]

PYTHON_TYPES: Mapping[str, type] = {name: kind for kind, name in JSON_TYPES.items()}
"""Types in Python by those of JSON Schema."""

NUMERIC = ("integer", "number")

_WORDS = {
    "boolean": "true or false",
    "array": "a list as JSON",
    "object": "an object as JSON",
}
_NAME = re.compile(rf"[A-Za-z_][A-Za-z0-9_]{{0,{NAME_MAX - 1}}}\Z")


class _OutOfBoundsError(StrandsRobotsError, ValueError):
    """A value that is left out; the text says why."""


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
        kind, bounds = self.type or "any", self.bounds
        measured = " ".join(filter(None, (bounds, self.unit)))
        return f"{kind}, {measured}" if measured else kind

    def problem(self, value: object) -> str:
        """Return why a value does not fit, in the robot's own words, or nothing."""
        # True is 1 to Python, and is not to a robot.
        kind = isinstance(value, bool)
        if self.choices and not any(each == value and isinstance(each, bool) is kind for each in self.choices):
            return f"{self.name} must be one of {', '.join(map(str, self.choices))}, not {shown(value)}."
        if self.type not in NUMERIC and (kind or not isinstance(value, int | float)):
            return ""
        try:
            (integral if self.type == "integer" else number)(self.name, value, low=self.low, high=self.high)
        except ValidationError as exc:
            return str(exc)
        return ""

    @property
    def bounds(self) -> str:
        """Its bounds in words; empty without any."""
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
        kind: ``read``, ``motion`` or ``stop``; what does not say that it reads is a motion.
        own: it is declared one of the robot's own, or the robot is none of ours.
        lasts_s: seconds that it may take before it answers; 0 for a verb that answers soon.
        stated: all its parameters are known; else it may take any.
        changes: it says that it moves nothing, and is a motion to its callers all the same: not every caller may.
    """

    name: str
    description: str
    parameters: tuple[AdvertisedParameter, ...]
    leases: frozenset[str]
    kind: VerbKind
    own: bool
    lasts_s: float
    stated: bool
    changes: bool = False

    @property
    def reads(self) -> bool:
        """True for a read."""
        return self.kind == "read"

    @property
    def summary(self) -> str:
        """The first line of its description."""
        return self.description.partition("\n")[0]

    @property
    def purpose(self) -> str:
        """Its description without the list of the parameters, which are described by themselves."""
        stated = self.parameters or self.leases
        return self.description.partition("\n\nArgs:")[0].strip() if stated else self.description

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
        """Return the refusal of arguments that a motion does not have, or nothing.

        Reads and stops ignore what they do not know, at the robot as well.
        """
        if self.kind != "motion":
            return ""
        from strands_robots.serving.verbs import LEASE_NAMES  # noqa: PLC0415 - who needs the names of our verbs loads no table

        known = [each.name for each in self.parameters]
        absent = [shown(each) for each in names if each not in known and (self.stated or each in LEASE_NAMES)]
        if not absent:
            return ""
        return f"{self.name} takes no argument {', '.join(absent[:3])}; its arguments: {', '.join(known) or 'none'}."


@dataclass(frozen=True, slots=True)
class RobotDescription:
    """Verbs of a robot by their names on the wire.

    Attributes:
        left_out: parts of the description that are out of bounds.
        lacking: what a device that is none of ours may not have: a lockout, a lease, a stop.
    """

    verbs: Mapping[str, AdvertisedVerb] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    lacking: tuple[str, ...] = ("lockout", "lease", "stop")

    @classmethod
    def of(cls, functions: object) -> RobotDescription:
        """Read the functions that a robot announces; never raises."""
        if not isinstance(functions, list | tuple):
            return cls(left_out=() if functions is None else (f"its verbs, which are no list: {shown(functions)}",))
        verbs, left_out, lacking, left = dict[str, AdvertisedVerb](), _LeftOut(), _lacking(functions), TOTAL_MAX
        # Its own ones first: the others are known without its description.
        for function in sorted(functions, key=_declared_own, reverse=True)[:VERBS_MAX]:
            share = min(left, VERB_MAX)
            reader = _Reader(share, left_out)
            try:
                verb = reader.verb(function, foreign="lockout" in lacking)
            except _OutOfBoundsError as exc:
                left_out.add(str(exc))
            else:
                if verbs.setdefault(verb.name, verb) is not verb:
                    left_out.add(f"a second verb {verb.name}")
            # What was looked at in vain counts as well, which bounds the time.
            left -= share - max(reader.left, 0)
        if len(functions) > VERBS_MAX:
            left_out.add(f"{len(functions) - VERBS_MAX} verbs after the first {VERBS_MAX}")
        in_order = {name: verbs[name] for name in verb_names(functions) if name in verbs}
        return cls(MappingProxyType(in_order), left_out.named(), lacking)

    @property
    def absent(self) -> str:
        """A sentence on what a device lacks to be stopped and held, or nothing."""
        lacks = [f"no {what}" for what in self.lacking]
        return f"This device has {' and '.join(filter(None, (', '.join(lacks[:-1]), lacks[-1])))}." if lacks else ""


def find_verb(functions: object, name: str) -> AdvertisedVerb | None:
    """Return the verb of a name, or None."""
    named = next((each for each in _rows(functions) if each["name"] == name), None)
    try:
        return None if named is None else _Reader(VERB_MAX, _LeftOut()).verb(named, "lockout" in _lacking(functions))
    except _OutOfBoundsError:
        return None


def verb_names(functions: object) -> list[str]:
    """Return the names of a robot's verbs."""
    return [each["name"] for each in _rows(functions)]


def fitting(rows: Iterable[T], most: int) -> list[T]:
    """Return the rows whose JSON is within so many bytes together, the first ones first."""
    within, left = list[T](), most
    for each in rows:
        size = len(json.dumps(each)) + 2
        if size <= left:
            left -= size
            within.append(each)
    return within


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
    elif value is not None and wanted in _WORDS and not isinstance(value, PYTHON_TYPES[wanted]):
        raise ValidationError(f"{parameter.name} must be {_WORDS[wanted]}, not {shown(text)}.")
    problem = parameter.problem(value) if value is not None else ""
    if problem:
        raise ValidationError(problem)
    return value


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

    def verb(self, function: object, foreign: bool) -> AdvertisedVerb:
        name = function.get("name") if isinstance(function, Mapping) else None
        if not isinstance(function, Mapping) or not isinstance(name, str) or not _NAME.match(name):
            raise _OutOfBoundsError(f"a verb whose name is no identifier of at most {NAME_MAX} letters: {shown(name)}")
        self._take(len(name), name)
        from strands_robots.serving.verbs import LEASE_NAMES  # noqa: PLC0415 - as above

        description, labels = self._text(function.get("description"), name), _object(function, "labels")
        schema = _object(function, "parameters")
        stated, required = schema.get("properties"), schema.get("required")
        properties = stated if isinstance(stated, Mapping) else {}
        needed = set(_texts(required)) if isinstance(required, list | tuple) else set()
        # A lease that has to be given is what the verb is about, as in renewControl.
        leases = (LEASE_NAMES & properties.keys()) - needed
        others = ((each, said) for each, said in properties.items() if each not in leases)
        read = [self._parameter(name, each, said, needed) for each, said in islice(others, PARAMETERS_MAX)]
        parameters = tuple(each for each in read if each is not None)
        more = len(properties) - len(leases) - PARAMETERS_MAX
        if more > 0:
            self._left_out.add(f"{more} parameters of {name}")
        kind: VerbKind = "read" if labels.get("direction") == "read" else "motion"
        return AdvertisedVerb(
            name=name,
            description=description,
            parameters=parameters,
            leases=leases,
            kind="stop" if name in STOPS else kind,
            own=foreign or _declared_own(function),
            lasts_s=_seconds(labels.get("lasts_s")),
            stated=isinstance(stated, Mapping) and len(parameters) == len(properties) - len(leases),
            changes=kind == "motion" and labels.get("changes") in ("true", True),
        )

    def _parameter(self, verb: str, name: object, said: object, needed: set[str]) -> AdvertisedParameter | None:
        if not isinstance(name, str) or not _NAME.match(name):
            self._left_out.add(f"parameter {shown(name)} of {verb}, whose name is no identifier")
            return None
        try:
            self._take(len(name), verb)
            # Its schema stands on the third level: parameters, properties, parameter.
            schema = self._copy(said if isinstance(said, Mapping) else {}, verb, name, 3)
        except _OutOfBoundsError as exc:
            self._left_out.add(str(exc))
            return None
        kind, choices, unit, meaning = (schema.get(each) for each in ("type", "enum", "unit", "description"))
        kinds = [each for each in _texts(kind if isinstance(kind, list) else [kind]) if each != "null"]
        scalars = [each for each in choices if _is_scalar(each)] if isinstance(choices, list) else []
        return AdvertisedParameter(
            name=name,
            type=kinds[0] if len(kinds) == 1 and kinds[0].isalpha() else "",
            meaning=meaning if isinstance(meaning, str) else "",
            required=name in needed,
            default=schema["default"] if _is_scalar(schema.get("default")) else None,
            low=_number(schema.get("minimum")),
            high=_number(schema.get("maximum")),
            # Of a choice that is too long the robot checks the value itself.
            choices=tuple(scalars) if len(scalars) <= CHOICES_MAX else (),
            unit=plain_text(unit, UNIT_MAX),
            schema=schema,
        )

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
        if isinstance(value, float):
            return value if isfinite(value) else None
        return value if isinstance(value, int) and abs(value) < WHOLE_MAX else None

    def _text(self, value: object, verb: str, longest: int = TEXT_MAX) -> str:
        self._take(min(len(value), 2 * longest) if isinstance(value, str) else 0, verb)
        return plain_text(value, longest, lines=True)

    def _take(self, characters: int, verb: str) -> None:
        self.left -= characters
        if self.left < 0:
            raise _OutOfBoundsError(f"{verb}, or a part of it, which is too long")


def _rows(functions: object) -> Iterator[Mapping[str, Any]]:
    """Yield the descriptions that have the name of a verb."""
    for each in functions if isinstance(functions, list | tuple) else ():
        name = each.get("name") if isinstance(each, Mapping) else None
        if isinstance(name, str) and _NAME.match(name):
            yield each


def _lacking(functions: object) -> tuple[str, ...]:
    """Return what a device lacks, by all of its verbs."""
    rows = {each["name"]: each for each in _rows(functions)}
    resume = _object(rows.get("resume", {}), "parameters")
    has = {
        "lockout": "assertion" in _object(resume, "properties"),
        "lease": rows.keys() >= {"acquireControl", "renewControl", "releaseControl"},
        "stop": not rows.keys().isdisjoint(STOPS),
    }
    return tuple(name for name, there in has.items() if not there)


def _declared_own(function: object) -> bool:
    return isinstance(function, Mapping) and _object(function, "labels").get("own") in ("true", True)


def _object(holder: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = holder.get(name)
    return value if isinstance(value, Mapping) else {}


def _texts(values: Iterable[object]) -> Iterator[str]:
    return (each for each in islice(values, PARAMETERS_MAX * 2) if isinstance(each, str))


def _is_scalar(value: object) -> bool:
    return isinstance(value, Scalar)


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def _seconds(label: object) -> float:
    """Return the seconds of a label, 0 for what is none."""
    try:
        seconds = float(label) if isinstance(label, str | int | float) and len(shown(label)) <= UNIT_MAX else 0.0
    except (ValueError, OverflowError):
        return 0.0
    return seconds if 0.0 <= seconds <= DURATION_MAX_S else 0.0
