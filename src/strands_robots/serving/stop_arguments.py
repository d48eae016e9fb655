"""Arguments of stops: no face refuses a stop for one of them.

What cannot be read is left out, which stops more and never less, and the answer says so under ``ignored``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from strands_robots.envelope import Envelope
from strands_robots.safety.orders import REASON_MAX
from strands_robots.serving.robot_verbs import WORLD_VERBS
from strands_robots.serving.verbs import unknown_arguments
from strands_robots.utils import ValidationError, device_id

_OF_ROBOT = WORLD_VERBS["stop"]


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


def noted(answer: Envelope, *notes: str) -> Envelope:
    """Return the answer to a stop with the notes on what was dropped."""
    said = _joined(*notes)
    return {**answer, "ignored": said} if said else answer


def network_stop(given: Mapping[str, Any]) -> tuple[dict[str, str], str]:
    """Return ``robot`` and ``robot_name`` of a client's stop, and a note."""
    robot, unknown = stop_robot("robot", given.get("robot"))
    of_world, unread = _OF_ROBOT.readable({name: value for name, value in given.items() if name != "robot"})
    return {"robot": robot, "robot_name": of_world["robot_name"] if robot else ""}, _joined(unknown, unread)


def network_emergency_stop(given: Mapping[str, Any]) -> tuple[dict[str, str], str]:
    """Return the ``reason`` of an emergency stop by a client, and a note."""
    reason, cut = stop_reason(given.get("reason"))
    return {"reason": reason}, _joined(cut, unknown_arguments(len(given) - ("reason" in given)))


def _joined(*notes: str) -> str:
    return "; ".join(filter(None, notes))
