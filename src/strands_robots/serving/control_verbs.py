"""Verbs of the control lease: acquire, renew, release, take and read it."""

from __future__ import annotations

from strands_robots.contract import Robot, holds_robots
from strands_robots.envelope import Envelope, is_error, success
from strands_robots.serving.control import KINDS, TTL_S, ControlLease, ControlLeases
from strands_robots.serving.verbs import (
    LEASE_ID,
    LEASE_ID_MAX,
    TTL_MAX_S,
    TTL_MIN_S,
    Arguments,
    Kind,
    Parameter,
    Verb,
    table,
)
from strands_robots.utils import choice, number, text

_KIND = Parameter(
    "kind",
    str,
    f"Who will move it: {', '.join(KINDS)}",
    lambda name, value: choice(name, value, KINDS),
    default="agent",
)
_TTL = Parameter(
    "ttl_s",
    float,
    f"Seconds without a call after which it is free again, {TTL_MIN_S:g} to {TTL_MAX_S:g}",
    lambda name, value: number(name, value, low=TTL_MIN_S, high=TTL_MAX_S),
    default=TTL_S,
)
_HELD = Parameter(
    LEASE_ID,
    str,
    "The lease_id of acquireControl or takeControl",
    lambda name, value: text(name, value, longest=LEASE_ID_MAX),
)
_REASON = Parameter("reason", str, "Why, 1 to 200 characters", lambda name, value: text(name, value, longest=200))
_ASSERTION = Parameter(
    "assertion",
    dict,
    "What the operator's key signed: v, purpose, robot, epoch (of getControl), t, nonce and sig",
    lambda name, value: value,  # the lease refuses what was not signed
    default=None,
)


def _lease(arguments: Arguments) -> ControlLease:
    leases: ControlLeases = arguments["leases"]
    return leases.of(arguments.get("robot_name", "") or "")


def _acquire(robot: Robot, arguments: Arguments) -> Envelope:
    held = arguments.get(LEASE_ID, "") or ""
    answer = _lease(arguments).acquire(arguments["caller"], arguments["kind"], arguments["ttl_s"], held)
    return _of_one(robot, arguments, answer)


def _renew(robot: Robot, arguments: Arguments) -> Envelope:
    return _lease(arguments).renew(arguments[LEASE_ID])


def _release(robot: Robot, arguments: Arguments) -> Envelope:
    return _lease(arguments).release(arguments[LEASE_ID])


def _take(robot: Robot, arguments: Arguments) -> Envelope:
    name, device = arguments.get("robot_name", "") or "", arguments["robot"]
    who = f"{device}/{name}" if name else device
    answer = _lease(arguments).take(arguments["caller"], arguments["reason"], who, arguments.get("assertion"))
    return _of_one(robot, arguments, answer)


def _of_one(robot: Robot, arguments: Arguments, answer: Envelope) -> Envelope:
    """Name the robot of a world whose lease it is."""
    if not holds_robots(robot) or is_error(answer):
        return answer
    return {**answer, "robot_name": arguments.get("robot_name") or next(iter(robot.list_robots()), "")}


def _read(robot: Robot, arguments: Arguments) -> Envelope:
    facts = _lease(arguments).facts()
    held = f"{facts['holder']} ({facts['kind']}) holds control." if facts["held"] else "Nobody holds control."
    return success(held, **facts)


CONTROL_VERBS = table(
    [
        Verb(
            "acquireControl",
            Kind.MOTION,
            "Hold a free robot: it then moves only with your lease_id, and halts when you have been silent for ttl_s.",
            (_KIND, _TTL),
            returns="lease_id, epoch, expires_in_s, robot_name; refused with the holder and the seconds left",
            run=_acquire,
            on_lease=True,
            critical=False,
        ),
        Verb(
            "renewControl",
            Kind.RESUME,
            "Start the time of your lease anew; every motion does so too.",
            (_HELD,),
            returns="epoch, expires_in_s",
            run=_renew,
            on_lease=True,
            urgent=True,
        ),
        Verb(
            "releaseControl",
            Kind.RESUME,
            "Free the robot for others.",
            (_HELD,),
            returns="epoch",
            run=_release,
            on_lease=True,
            urgent=True,
        ),
        Verb(
            "takeControl",
            Kind.RESUME,
            "A human takes the robot from its holder, by the operator's signature; it is halted before the answer.",
            (_REASON, _ASSERTION),
            returns="lease_id, epoch, expires_in_s",
            run=_take,
            on_lease=True,
            urgent=True,
        ),
        Verb(
            "getControl",
            Kind.READ,
            "Read who holds the robot.",
            returns="held, holder, kind, epoch, for_one_motion, expires_in_s",
            run=_read,
            on_lease=True,
            urgent=True,
        ),
    ]
)
