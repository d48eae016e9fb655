"""Bounds of commands and input frames, checked once at the edge.

Identifiers and :class:`ValidationError` are :mod:`strands_robots.utils`'s; this module is their documented path on
the mesh, and holds the table of a command's fields. A machine reads ``ValidationError.code``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.mesh.former_actions import FORMER, checked_former
from strands_robots.moved import of_module
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.verbs import Kind, Verb
from strands_robots.utils import ValidationError, identifier, mapping, number, peer_id, shown

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


__all__ = [
    "ValidationError",
    "validate_command",
    "validate_input_frame",
    "validate_mesh_identifier",
    "validate_peer_id",
]

TELEOP_VALUE_OUT_OF_RANGE = "TELEOP_VALUE_OUT_OF_RANGE"

INPUT_KEYS = 64
INPUT_KEY_CHARACTERS = 64
INPUT_VALUE_ABS = 720.0
PROVIDER = "policy_provider"
_INPUT_KEY = re.compile(rf"[A-Za-z0-9_.-]{{1,{INPUT_KEY_CHARACTERS}}}\Z")


def validate_mesh_identifier(value: object, name: str = "identifier") -> str:
    """A turn, sender, device or peer named in a message.

    Raises:
        ValidationError: anything but 1 to 128 letters, digits, ``.``, ``_``, ``-``, the first one alphanumeric.
    """
    return identifier(name, value)


def validate_peer_id(value: object) -> str:
    """A peer id: an identifier that is none of the reserved words."""
    return peer_id("peer_id", value)


def _as_sent(verb: Verb) -> Verb:
    """Return a verb that takes the name of any policy, as its robot has others."""

    def named(name: str, value: object) -> str:
        return "" if value == "" == verb.by_name[name].default else identifier(name, value)

    parameters = [replace(each, check=named) if each.name == PROVIDER else each for each in verb.parameters]
    return replace(verb, parameters=tuple(parameters))


_SENT = {name: _as_sent(verb) for name, verb in PEER_VERBS.items()}
"""The verbs as their sender checks them."""


def validate_command(command: object) -> dict[str, Any]:
    """Return the command with defaults filled in and what it does not read left out.

    Args:
        command: an object with ``action`` and that action's fields. A ``call`` of 0.5 is returned as it is: its
            receiver checks the arguments.

    A motion is refused for a field that it does not read, a read never. A stop is refused for none of its fields: what
    cannot be read is dropped, which stops more. A resume's assertion
    is passed on unchanged: the check of its signature counts refusals. A policy is named by an identifier: which ones
    there are is the robot's to say.

    Raises:
        ValidationError: naming the field, the value and its domain.
    """
    given = mapping("command", command)
    action = given.get("action")
    verb = _SENT.get(action) if isinstance(action, str) else None
    if isinstance(action, str) and action in FORMER:
        return checked_former(given)
    if verb is None:
        raise ValidationError(f"action must be one of {', '.join(PEER_VERBS)}, not {shown(action)}.")
    if verb.kind is Kind.STOP:
        readable, _ = verb.readable(given)
        return {"action": verb.name, **{name: value for name, value in readable.items() if value is not None}}
    return {"action": verb.name, **verb.checked(given)}


def check_input_key(key: str) -> None:
    """Refuse a key of an input frame that can be no joint's.

    Raises:
        ValidationError: anything but 1 to 64 letters, digits, ``.``, ``_``, ``-``, or two dots in a row.
    """
    if not _INPUT_KEY.match(key) or ".." in key:
        domain = f"1 to {INPUT_KEY_CHARACTERS} letters, digits, '.', '_' or '-', without two dots in a row"
        raise ValidationError(f"the keys of action must be {domain}, not {shown(key)}.")


def validate_input_frame(action: object, *, limit: float | None = None) -> dict[str, float]:
    """The action of one input frame as floats by joint.

    Args:
        action: at most 64 keys as :func:`check_input_key` has them, each a finite number.
        limit: largest magnitude; ``STRANDS_MESH_INPUT_VALUE_ABS`` where None.

    Raises:
        ValidationError: a shape or key out of bounds; code TELEOP_VALUE_OUT_OF_RANGE for a number out of them.
    """
    most = settings.number("STRANDS_MESH_INPUT_VALUE_ABS") if limit is None else limit
    given = mapping("action", action)
    if len(given) > INPUT_KEYS:
        raise ValidationError(f"action must have at most {INPUT_KEYS} keys, not {len(given)}.")
    for key in given:
        check_input_key(key)
    try:
        return {key: number(key, value, low=-most, high=most) for key, value in given.items()}
    except ValidationError as exc:
        raise ValidationError(str(exc), TELEOP_VALUE_OUT_OF_RANGE) from None
