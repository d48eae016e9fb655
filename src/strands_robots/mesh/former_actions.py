"""Calls of a peer's functions by 0.5 releases, as commands of its verbs.

``call`` names a ``function`` and its ``params``, ``sim_call`` the same as ``sim_action``, and ``describe_tool`` asks
for the functions. A peer serves them as the verb of that name, through the same checks as every command.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from strands_robots.utils import ValidationError, finite, mapping, shown, text

FUNCTION_MAX = 64

_CALLS = {"call": "function", "sim_call": "sim_action"}
_FUNCTIONS = {
    "describe_tool": "describe",
    "get_features": "features",
    "get_state": "state",
    "halt": "stop",
    "run_policy": "execute",
    "start_policy": "start",
    "stop_motion": "stop",
    "stop_policy": "stop",
    "stop_task": "stop",
}

SET_JOINTS = (
    "set_joints is not served: it put a simulation's joints elsewhere at once. Use moveJoints, which moves them there, "
    "in degrees by joint name."
)

FORMER = frozenset({*_CALLS, "describe_tool", "set_joints"})
"""Actions of 0.5 releases that are no verbs here."""


def stops(command: Mapping[str, Any]) -> bool:
    """Return True for a call that stops, which is refused for none of its fields."""
    action = command.get("action")
    function = command.get(_CALLS[action]) if isinstance(action, str) and action in _CALLS else None
    return isinstance(function, str) and _FUNCTIONS.get(function, function) == "stop"


def checked_former(command: Mapping[str, Any]) -> dict[str, Any]:
    """Return a command of a former action as it is sent.

    Only its receiver knows the function.

    Raises:
        ValidationError: no function, its params are no object, or a number is not finite.
    """
    name = _CALLS.get(command["action"])
    if stops(command):
        params = command.get("params")
        named = params.get("robot_name") if isinstance(params, Mapping) else None
        meant = {"params": {"robot_name": named}} if isinstance(named, str) else {}
        return {"action": command["action"], str(name): command[str(name)], **meant}
    finite("command", command)
    if name is not None:
        text(name, command.get(name), longest=FUNCTION_MAX)
        mapping("params", command.get("params") or {})
    return dict(command)


def as_verb(command: Mapping[str, Any], verbs: Collection[str]) -> dict[str, Any]:
    """Return the command of the verb that a former action means.

    Args:
        verbs: those of the peer.

    Raises:
        ValidationError: the peer has none of that name, or the action is not served, with what to use instead.
    """
    action = command["action"]
    if action == "set_joints":
        raise ValidationError(SET_JOINTS)
    name = _CALLS.get(action)
    function = action if name is None else text(name, command.get(name), longest=FUNCTION_MAX)
    verb = next((each for each in (_FUNCTIONS.get(function, function), _camel(function)) if each in verbs), None)
    if verb is None:
        raise ValidationError(f"{name} {shown(function)} is no verb of this peer; describe lists its verbs.")
    rest = {key: value for key, value in command.items() if key not in ("action", name, "params")}
    params = command.get("params") or {}
    if not stops(command):
        mapping("params", params)
    return {**rest, **(params if isinstance(params, Mapping) else {}), "action": verb}


def _camel(function: str) -> str:
    head, *rest = function.split("_")
    return head + "".join(part[:1].upper() + part[1:] for part in rest)
