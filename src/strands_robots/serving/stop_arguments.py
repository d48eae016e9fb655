"""Arguments of stops: no face refuses a stop for one of them.

What cannot be read is left out, which stops more and never less, and the answer says so under ``ignored``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from strands_robots.envelope import Envelope
from strands_robots.safety.orders import REASON_MAX
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.serving.verbs import unknown_arguments
from strands_robots.utils import ValidationError, device_id


def stop_reason(value: object) -> tuple[str, str]:
    """Return the reason of a stop as it is sent, and a note on what was dropped.

    A reason is text of up to 200 printable characters, and may be empty.
    """
    if value is None or value == "":
        return "", ""
    if not isinstance(value, str):
        return "", f"reason is a {type(value).__name__} and no text"
    said = "".join(each if each.isprintable() else " " for each in value[:REASON_MAX]).strip()
    if len(value) > REASON_MAX:
        return said, f"reason was cut to {REASON_MAX} of {len(value)} characters"
    return said, "" if value.isprintable() else "characters of reason that cannot be printed"


def stop_of(verb: str, caller: str | None) -> str:
    """Return the reason of a stop: the verb, and the name that the caller states."""
    return f"{verb} by {caller}" if caller else verb


def stop_robot(name: str, value: object) -> tuple[str, str]:
    """Return the id of the robot that a stop means, empty for all, and a note.

    Args:
        name: of the argument, for the note.
    """
    if value is None or value == "":
        return "", ""
    try:
        return device_id(name, value if isinstance(value, str) else ""), ""
    except ValidationError:
        return "", f"{name} is no robot's id, so all robots are stopped"


def stop_scope(only: object, cell: object) -> tuple[Scope, str]:
    """Return the robots that an emergency stop is for, and a note.

    What cannot be read, or both at once, is every robot. A robot of a world, ``world/robot``, is locked with its world.

    Args:
        only: names, or one name; None or empty for no choice.
        cell: name of a cell; None or empty for no choice.
    """
    if only in (None, "", []) and cell in (None, ""):
        return EVERY_ROBOT, ""
    if only not in (None, "", []) and cell not in (None, ""):
        return EVERY_ROBOT, "only and cell are given together, so all robots are stopped"
    if cell:
        scope = Scope.read({"cell": cell})
        return scope, "cell is no cell's name, so all robots are stopped" if scope.everything else ""
    named = [only] if isinstance(only, str) else only
    names = list(named) if isinstance(named, list | tuple) else [None]
    whole = [each.partition("/")[0] if isinstance(each, str) else each for each in names]
    scope = Scope.read({"only": whole})
    if scope.everything:
        return scope, "only names what is no robot's id, or too many, so all robots are stopped"
    return scope, "" if whole == names else "a robot of a world is locked with its whole world"


def robot_of_world(given: Mapping[str, Any]) -> tuple[str, str]:
    """Return the robot of a device's world that a stop means, empty for all, and a note."""
    # A command that stops all leaves before the verbs are loaded.
    from strands_robots.serving.robot_verbs import WORLD_VERBS  # noqa: PLC0415

    arguments, unread = WORLD_VERBS["stop"].readable(given)
    return str(arguments["robot_name"]), unread


def noted(answer: Envelope, *notes: str) -> Envelope:
    """Return the answer to a stop with the notes on what was dropped."""
    said = _joined(*notes)
    return {**answer, "ignored": said} if said else answer


def network_stop(given: Mapping[str, Any]) -> tuple[dict[str, str], str]:
    """Return ``robot`` and ``robot_name`` of a client's stop, and a note."""
    robot, unknown = stop_robot("robot", given.get("robot"))
    name, unread = robot_of_world({name: value for name, value in given.items() if name != "robot"})
    return {"robot": robot, "robot_name": name if robot else ""}, _joined(unknown, unread)


def network_emergency_stop(given: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the arguments of a client's emergency stop, and a note."""
    reason, cut = stop_reason(given.get("reason"))
    scope, unread = stop_scope(given.get("only"), given.get("cell"))
    unknown = unknown_arguments(len(given.keys() - {"reason", "only", "cell"}))
    arguments = {"reason": reason, "only": sorted(scope.only), "cell": scope.cell}
    return arguments, _joined(cut, unread, unknown)


def _joined(*notes: str) -> str:
    return "; ".join(filter(None, notes))
