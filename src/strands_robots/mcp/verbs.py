"""Verbs as robots describe them: shown to a client, and looked up for a call."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.fleet.adapter import FoundRobot
from strands_robots.mcp.results import row
from strands_robots.serving.advertised import STOPS, AdvertisedVerb, RobotDescription, find_verb, fitting, verb_names
from strands_robots.utils import near, shown

VERBS_BYTES = 28_000
"""Size of a robot's verbs in its description, which is in an answer twice as well: 64 kB in all."""

INSTEAD = {
    **dict.fromkeys(STOPS, "use stop"),
    "emergencyStop": "use emergency_stop",
    "acquireControl": "use acquire_control",
    "releaseControl": "use release_control",
    "renewControl": "the server renews what acquire_control gave",
    "takeControl": "only a human takes control from another client",
    "resume": "only a human operator resumes a robot",
    "wait": "use wait_for",
}
"""Verbs that ``call_robot`` refuses, and what to do instead."""


def described(found: FoundRobot) -> Envelope:
    """Return a robot's description: its verbs in its own words, within a bound."""
    description = RobotDescription.of(found.functions)
    known = [each for each in description.verbs.values() if each.name not in INSTEAD]
    # Its own ones first: the others are known without it.
    rows = [_verb_row(each) for each in sorted(known, key=lambda each: not each.own)]
    verbs = fitting(rows, VERBS_BYTES)
    more = sum(name not in INSTEAD for name in verb_names(found.functions)) - len(verbs)
    left_out = {"verbs_left_out": more} if more else {}
    note = {"note": description.absent} if description.absent else {}
    return success("Described, in the robot's words.", **row(found), **note, **left_out, verbs=verbs)


def _verb_row(verb: AdvertisedVerb) -> dict[str, Any]:
    return {
        "name": verb.name,
        "description": verb.purpose,
        "moves": not verb.reads,
        **({"own": True} if verb.own else {}),
        **({"lasts_s": verb.lasts_s} if verb.lasts_s else {}),
        "parameters": verb.schema(),
    }


def wanted(robot: FoundRobot, verb: str, arguments: Iterable[str]) -> AdvertisedVerb | Envelope:
    """Return the verb that a client wants to call, or why it is refused."""
    found = find_verb(robot.functions, verb)
    if found is None:
        alike = near(verb, (name for name in verb_names(robot.functions) if name not in INSTEAD))
        return error(f"{shown(robot.id)} has no verb {shown(verb)}.{alike}")
    problem = found.unknown(arguments)
    return error(problem) if problem else found
