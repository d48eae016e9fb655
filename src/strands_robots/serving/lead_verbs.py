"""Verbs of a leader elsewhere: it begins to lead, and sends its commands.

A robot that is led this way says in each answer what it really did, so a leader needs nothing else of the network.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from strands_robots.contract import body_of, for_request
from strands_robots.envelope import Envelope, error
from strands_robots.policies.handover import GUIDES, LEAD_S, PICTURE_MAX_MS
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving.arm_verbs import JOINTS_MAX, optional, within
from strands_robots.serving.policy_arguments import known_provider
from strands_robots.serving.verbs import DURATION, Arguments, Kind, Verb, between, table
from strands_robots.teleoperators import FULL_RANGES_PER_S
from strands_robots.utils import DURATION_MAX_S, ValidationError, choice, flag, identifier, mapping, number, shown, text
from strands_robots.verb_parameters import Parameter

VALUE_MAX = 1e6
"""Largest magnitude of a target."""

SEQ_MAX = 2**53
"""Largest number of a command or turn that every reader of JSON keeps exact."""


def _targets(name: str, value: object) -> dict[str, float]:
    given = mapping(name, value)
    if len(given) > JOINTS_MAX:
        raise ValidationError(f"{name} must name at most {JOINTS_MAX} joints, not {len(given)}.")
    bound = {"low": -VALUE_MAX, "high": VALUE_MAX}
    return {_key(key): number(f"{name}[{shown(key)}]", at, **bound) for key, at in given.items()}


def _key(key: object) -> str:
    return text("joint", key, longest=128)


def _provider(name: str, value: object) -> str:
    return "" if value == "" else known_provider(name, value)


def _begins(robot: Any, arguments: Arguments, request: MotionRequest | None) -> object:
    """Begin a lead."""
    lead = getattr(body_of(robot), "lead", None)
    if not callable(lead):
        return error("lead: this robot follows no leader elsewhere.")
    return for_request(request, lead)(**arguments)


def _takes(robot: Any, arguments: Arguments) -> Envelope:
    lead_to = getattr(body_of(robot), "lead_to", None)
    if not callable(lead_to):
        return error("leadTo: this robot follows no leader elsewhere.")
    given = {name: value for name, value in arguments.items() if name != "robot_name"}
    answer: Envelope = lead_to(**given)
    return answer


def is_led(robot: Any) -> bool:
    """Return True for a robot or a world that follows leaders elsewhere."""
    body = body_of(robot)
    robots = getattr(body, "list_robots", None)
    return callable(getattr(body, "lead", None)) and (not callable(robots) or bool(robots()))


_clock = partial(number, low=-1e12, high=1e12)

LEAD_VERBS = table(
    [
        Verb(
            "lead",
            Kind.MOTION,
            "Let a leader elsewhere drive the robot by leadTo, alone or in turns with a policy; it holds until then.",
            (
                Parameter("leader", str, "Name of the leader", identifier, default="leader"),
                Parameter("duration", float, DURATION.meaning, DURATION.check, default=LEAD_S),
                Parameter(
                    "guide",
                    str,
                    "How the leader's numbers are meant: positions, or differences from the beginning of its turn",
                    lambda name, value: choice(name, value, GUIDES),
                    default="positions",
                ),
                Parameter(
                    "stale_ms",
                    float,
                    "Age of the operator's newest picture beyond which the robot holds, 20 to 10000",
                    within(20, 10_000),
                    default=PICTURE_MAX_MS,
                ),
                Parameter(
                    "policy_provider",
                    str,
                    "Policy that drives until the leader takes over; empty for none",
                    _provider,
                    default="",
                ),
                Parameter(
                    "instruction",
                    str,
                    "The policy's task, at most 2000 characters; empty without one",
                    lambda name, value: text(name, value, longest=2000, empty=True),
                    default="",
                ),
                Parameter(
                    "max_speed",
                    float,
                    "Whole joint ranges a second that the leader may cross, above 0, at most 20",
                    lambda name, value: number(name, value, above=0, high=20),
                    default=FULL_RANGES_PER_S,
                ),
            ),
            returns="lead_id, leader, robot, hz, ranges, state, why, turn, seq, joints, written, one_way_ms, now",
            method="lead",
            begin=_begins,
            suits=is_led,
        ),
        Verb(
            "leadTo",
            Kind.RESUME,
            "Send one command of a leader; a new turn takes over from the policy or a hold, or gives back.",
            (
                Parameter("lead_id", str, "The lead_id of lead", lambda name, value: text(name, value, longest=64)),
                Parameter("seq", int, "Number of the command, greater than the one before", between(0, SEQ_MAX)),
                Parameter("turn", int, "Number of the turn, greater than the one before", between(0, SEQ_MAX), 1),
                Parameter("leads", bool, "Whether the leader drives in it, or the policy", flag, default=True),
                Parameter("targets", dict, "Targets by joint, in the robot's units", optional(_targets), default=None),
                Parameter("made", float, "The leader's clock at the making, in seconds", _clock, default=0.0),
                Parameter("told", float, "now of the last answer that the leader has", _clock, default=0.0),
                Parameter(
                    "told_ago", float, "Seconds from that answer to the making", within(0, DURATION_MAX_S), default=0.0
                ),
                Parameter(
                    "picture_age_ms",
                    float,
                    "Age of the newest picture that the operator saw; left out without pictures",
                    optional(within(0, 1e9)),
                    default=None,
                ),
                Parameter("end", bool, "Whether to end the lead; the robot then holds", flag, default=False),
            ),
            returns="state, why, turn, seq, joints, written, one_way_ms, dropped, now",
            method="lead_to",
            run=_takes,
            suits=is_led,
            urgent=True,
            streamed=True,
        ),
    ]
)
"""The verbs of a leader elsewhere."""
