"""Every verb described once: name, parameters with domain and unit, result.

Device Connect makes its RPC methods and their schemas from these descriptions, the mesh its validation, and
``tests/serving/test_verbs.py`` holds the agent tool to them. A new verb is one entry here and one robot method.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from types import MappingProxyType
from typing import Any

from strands_robots.contract import for_request
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.lockout import is_epoch
from strands_robots.utils import (
    DURATION_MAX_S,
    ValidationError,
    alike,
    duration,
    identifier,
    integral,
    number,
    shown,
    text,
)
from strands_robots.verb_parameters import JSON_TYPES, REQUIRED, Check, Parameter, checked_arguments

Arguments = Mapping[str, Any]
"""Checked arguments, by parameter."""

Run = Callable[[Any, Arguments], object]
"""Carries a verb out on a robot; returns an envelope. What it raises is reported as a failure inside the device."""

Begin = Callable[[Any, Arguments, MotionRequest | None], object]
"""Carries a verb out as :data:`Run` does, with the request that its motion begins for."""

Suits = Callable[[Any], bool]
"""Says whether a robot can carry a verb out now."""


class Kind(Enum):
    """Decides what a verb passes on its way, and whom it may wait for."""

    MOTION = "motion"
    """Authorized, refused while locked, approved on hardware."""

    CHANGE = "change"
    """Authorized as a motion is; it moves nothing, so no lease, lockout or approval concerns it."""

    READ = "read"
    """Answered to every caller."""

    STOP = "stop"
    """Carried out for every caller, on threads of its own."""

    RESUME = "resume"
    """Authorized by what it brings: the operator's signature, or the secret of a lease."""


OF_ALLOWED_CALLERS = frozenset({Kind.MOTION, Kind.CHANGE})
"""Kinds for which the caller is authorized."""

LEASE_ID = "lease_id"

LEASE_ID_MAX = 64

_LEASE_ID = Parameter(
    LEASE_ID,
    str,
    "The lease_id of acquireControl; empty on a robot that nobody holds",
    lambda name, value: text(name, value, longest=LEASE_ID_MAX, empty=True),
    default="",
)

LEASE_TTL_S = "lease_ttl_s"

TTL_MIN_S, TTL_MAX_S = 0.5, 600.0
"""Bounds of the seconds after which a silent holder loses a robot."""


def _motion_ttl(name: str, value: object) -> float:
    if value == 0 and not isinstance(value, bool):
        return 0.0
    return number(name, value, low=TTL_MIN_S, high=TTL_MAX_S)


_LEASE_TTL = Parameter(
    LEASE_TTL_S,
    float,
    f"Seconds without renewControl after which this motion is halted, {TTL_MIN_S:g} to {TTL_MAX_S:g}, 0 for never; "
    "lease_id is then a secret of your own; a lease that you hold lasts no longer than that from then on",
    _motion_ttl,
    default=0.0,
)

OF_THE_LEASE = (_LEASE_ID, _LEASE_TTL)
LEASE_NAMES = frozenset(each.name for each in OF_THE_LEASE)


def _nonce(name: str, value: object) -> str:
    if value == "" or is_epoch(value):
        return str(value)
    raise ValidationError(f"{name} must be 32 hex digits, or empty, not {shown(value)}.")


NONCE = Parameter(
    "nonce", str, "32 hex digits, fresh, that the signed part of the answer repeats; empty for none", _nonce, default=""
)
"""Of the read that shows lockouts: an answer that was recorded before fits no other question."""


ROUTING = frozenset({"action", "turn_id", "sender_id", "target_id", "timestamp", "sig", "source_device", "_dc_meta"})
"""Fields by which networks and frameworks carry a command; no verb reads them."""

SENT_UNASKED: Mapping[str, object] = MappingProxyType({"policy_host": "localhost", "steps": 1})
"""Fields that the 0.5 releases add to a command, with the value that is so without them."""


UNKNOWN_MAX = 5
"""Unknown arguments that a refusal names."""

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}\Z")


def _says_nothing(name: str, value: object) -> bool:
    """Return True for a field that a command may bring, and no verb needs to read."""
    if value is None or name in ROUTING:
        return True
    unasked = SENT_UNASKED.get(name)
    return unasked is not None and type(value) is type(unasked) and value == unasked


@dataclass(frozen=True)
class Verb:
    """One thing that a caller may ask of a robot.

    Attributes:
        summary: one sentence for callers; with ``returns`` it is the description that agents read.
        method: the robot's method that carries the verb out, with the verb's arguments as its own. A robot that lacks
            it does not offer the verb.
        suits: returns False for a robot that cannot carry the verb out; None leaves that to ``method``. It is asked
            often and on event loops, so it reads and waits for nothing.
        run: a function that calls it, or acts in place of it. A verb with neither is the network peer's own.
        begin: the same for a verb that may begin a motion; it gets the command's request besides.
        critical: False for a motion that no bystander has to fear.
        leaves_out: arguments that are None are left out instead of refused, and an optional one that was not given
            stays out: the mesh's wire has it so.
        lasts: it is answered when the motion has ended, so it takes no turn from motions that are only started.
        urgent: it takes energy away, and waits for no read and no motion.
        while_locked: it works under a lockout; caller and operator are asked as for any motion.
        instead: the verb that a locked robot offers in the place of this one.
        of_world: a motion of all robots of a world; any other is of one, the first where none is named.
        on_lease: a verb of the control lease; its ``run`` gets ``caller``, ``robot`` and ``leases`` besides.
        note: what callers have to know besides, the second paragraph of its description.
        own: a verb that its robot declares (:func:`~strands_robots.verb_declaration.verb`).
        streamed: it is sent many times a second, and is in no audit record; what began it is.
        lasts_s: seconds that it may take to return, besides those that each verb of its kind has.
    """

    name: str
    kind: Kind
    summary: str
    parameters: tuple[Parameter, ...] = ()
    returns: str = ""
    method: str = ""
    run: Run | None = None
    begin: Begin | None = None
    suits: Suits | None = None
    critical: bool = True
    leaves_out: bool = False
    lasts: bool = False
    urgent: bool = False
    while_locked: bool = False
    instead: str = ""
    on_lease: bool = False
    of_world: bool = False
    note: str = ""
    own: bool = False
    streamed: bool = False
    lasts_s: float = 0.0
    by_name: Mapping[str, Parameter] = field(init=False, repr=False, compare=False)
    _defaults: Mapping[str, Any] = field(init=False, repr=False, compare=False)
    share: str = field(init=False, repr=False, compare=False)
    """The share of a robot's threads that carries it out, by its name in :class:`~.workers.Shares`."""
    leased: bool = field(init=False, repr=False, compare=False)
    """True for a motion of the lease's holder alone; it takes :data:`OF_THE_LEASE`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "share", self._share())
        object.__setattr__(self, "leased", self.kind is Kind.MOTION and not self.while_locked)
        if self.leased and all(each.name != LEASE_ID for each in self.parameters):
            more = [replace(each, default=None) if self.leaves_out else each for each in OF_THE_LEASE]
            object.__setattr__(self, "parameters", (*self.parameters, *more))
        object.__setattr__(self, "by_name", {each.name: each for each in self.parameters})
        object.__setattr__(self, "_defaults", {each.name: each.default for each in self.parameters})

    def call(self, robot: Any, arguments: Arguments, request: MotionRequest | None = None) -> Callable[[], object]:
        """Return the call that carries the verb out with a robot, and returns its answer.

        Args:
            robot: behind its contract.
            arguments: checked.
            request: what a motion begins for; a halt since it was made refuses the motion.
        """
        if self.begin is not None:
            return partial(self.begin, robot, arguments, request)
        if self.run is not None:
            return partial(self.run, robot, arguments)
        return partial(for_request(request, getattr(robot, self.method)), **arguments)

    def _share(self) -> str:
        # Only motions wait for motions.
        if self.urgent:
            return "urgent"
        if self.lasts and not (self.own and self.kind is not Kind.MOTION):
            return "lasting"
        return "motion" if self.kind is Kind.MOTION else "own_read" if self.own else "read"

    def unfit(self, names: Collection[str]) -> str | None:
        """Return the reason why arguments of these names do not fit, or None."""
        unknown = [name for name in names if name not in self.by_name]
        missing = [each.name for each in self.parameters if each.default is REQUIRED and each.name not in names]
        return self._unfit(unknown, missing) if unknown or missing else None

    def _unfit(self, unknown: list[str], missing: list[str]) -> str:
        takes = ", ".join(name for name in self.by_name if name not in LEASE_NAMES) or "no parameters"
        if not unknown:
            return f"{self.name} takes {takes}: {', '.join(missing)} is missing."
        more = f" and {len(unknown) - UNKNOWN_MAX} more" if len(unknown) > UNKNOWN_MAX else ""
        return f"{self.name} takes {takes}: it has no {', '.join(map(self._meant, unknown[:UNKNOWN_MAX]))}{more}."

    def _meant(self, name: str) -> str:
        """Return an unknown name with the one that its sender may have meant."""
        meant = alike(name, (each for each in self.by_name if each not in LEASE_NAMES), 1)
        stated = name if _WORD.match(name) else shown(name)
        return f"{stated} (did you mean {meant[0]}?)" if meant else stated

    def read(self, given: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the arguments without those that mean nothing to it.

        What would change a motion stays, to be refused: a misspelled duration would move the robot for 30 s. Reads
        ignore what they do not have, and every verb the fields of the frameworks and those of a value that only says
        what is so without them.
        """
        known = self.by_name
        if self.kind is Kind.READ or (self.leaves_out and self.kind is not Kind.MOTION):
            return {name: value for name, value in given.items() if name in known}
        return {name: value for name, value in given.items() if name in known or not _says_nothing(name, value)}

    def checked(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments in their domains, defaults filled in.

        Raises:
            ValidationError: naming the first argument that is unknown, missing or outside its domain.
        """
        if not given.keys() <= self.by_name.keys():
            given = self.read(given)
        if self.leaves_out:
            given = {name: value for name, value in given.items() if value is not None}
        arguments = {**self._defaults, **checked_arguments(self.by_name, given, self._unfit)}
        return {name: value for name, value in arguments.items() if value is not None or not self.leaves_out}

    def readable(self, given: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
        """Return the arguments of a stop that can be read, and a note on the others.

        A stop is refused for none of them: without one it stops more. A value that is no scalar is not looked at.
        """
        arguments = {each.name: each.default for each in self.parameters}
        unread = []
        for each in self.parameters:
            value = given.get(each.name)
            if value is None:
                continue
            try:
                arguments[each.name] = each.check(each.name, value if isinstance(value, str | int | float) else "\0")
            except ValidationError:
                unread.append(f"{each.name} is not readable, so everything is stopped")
        if not self.leaves_out:
            unread.append(unknown_arguments(len(given) - sum(name in given for name in self.by_name)))
        return arguments, "; ".join(filter(None, unread))


def unknown_arguments(count: int) -> str:
    """Return a note on arguments that a stop does not have, or nothing."""
    return f"{count} unknown argument{'s' if count > 1 else ''}" if count else ""


def table(verbs: Sequence[Verb]) -> dict[str, Verb]:
    """The verbs by name."""
    return {verb.name: verb for verb in verbs}


def _text(longest: int, *, empty: bool = False) -> Check:
    return lambda name, value: text(name, value, longest=longest, empty=empty)


def between(low: int, high: int) -> Check:
    """Check a whole number within these bounds."""
    return lambda name, value: integral(name, value, low=low, high=high)


INSTRUCTION = Parameter("instruction", str, "What to do, in plain language, 1 to 2000 characters", _text(2000))
POLICY_PROVIDER = Parameter(
    "policy_provider",
    str,
    "Policy that decides the actions, such as remote or lerobot_local; mock moves by itself and follows no instruction",
    identifier,
    default="mock",
)
DURATION = Parameter(
    "duration",
    float,
    f"Longest time the motion may take, in seconds, above 0 and at most {DURATION_MAX_S:g}",
    duration,
    default=30.0,
)
POLICY_PORT = Parameter(
    "policy_port",
    int,
    "TCP port of the policy's server, 1 to 65535; 0 for the provider's own",
    between(0, 65535),
    default=0,
)
ROBOT_NAME = Parameter(
    "robot_name",
    str,
    "Which robot of the world; empty for the first one",
    _text(128, empty=True),
    default="",
)
STEPS_MAX = 100_000
"""Physics steps of one ``step``: a few seconds of computing, within the time that a motion has to start."""

N_STEPS = Parameter("n_steps", int, f"Physics steps to take, 1 to {STEPS_MAX}", between(1, STEPS_MAX), default=1)
ASSERTION = Parameter(
    "assertion",
    dict,
    "What the operator's resume key signed: v, epoch, targets, t, nonce and sig",
    lambda name, value: value,  # the check of the signature counts refusals
)

MOTOR_IDS = Parameter(
    "motor_ids",
    str,
    "Comma list of motor names; empty for all",
    _text(1000, empty=True),
    default="",
)


def release_torque_verb(motor_ids: Parameter, **carried_out: Any) -> Verb:
    """Describe the ``releaseTorque`` of a robot whose motors ``motor_ids`` names."""
    return Verb(
        "releaseTorque",
        Kind.MOTION,
        "Stop the robot and switch its torque off, also while it is locked, as for a trapped finger; an arm falls.",
        (motor_ids,),
        returns="released, stopped, not_stopped, unknown",
        urgent=True,
        while_locked=True,
        **carried_out,
    )


RESUME = Verb(
    "resume",
    Kind.RESUME,
    "Free the robot of one emergency stop with an assertion of the operator's key; nothing starts to move by it.",
    (ASSERTION,),
    returns="epoch, locked, epochs",
    urgent=True,
)


Labels = dict[str, str | list[str]]


def labels_of(verb: Verb) -> Labels:
    """Return the labels of a verb: direction, whose it is, seconds to return.

    A change moves nothing and says so, besides what it has in common with a motion.
    """
    kind: Labels = {"direction": "read"} if verb.kind is Kind.READ else {"direction": "write"}
    if verb.kind is not Kind.READ and verb.critical:
        kind["safety"] = "critical"
    if verb.own:
        kind["own"] = "true"
    if verb.kind is Kind.CHANGE:
        kind["changes"] = "true"
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
