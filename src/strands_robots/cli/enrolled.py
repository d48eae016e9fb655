"""Options of ``enroll`` that list, exempt and forget enrolled robots."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from strands_robots.audit import log_safety_event
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.cli.resume import operator
from strands_robots.safety.identity import (
    OFF,
    RETIRED,
    EnrolledKeys,
    EnrolledRobot,
    Exemption,
    KeyFileError,
    fingerprint,
    local_name,
)
from strands_robots.safety.lockout import utc
from strands_robots.safety.sightings import sightings
from strands_robots.safety.silence import described
from strands_robots.utils import shown, text

REASON_MAX = 200

Retire = Annotated[str, typer.Option("--retire", metavar="NAME", help="It is gone for good: no stop waits for it.")]
Off = Annotated[str, typer.Option("--off", metavar="NAME", help="It is switched off: no stop waits for it.")]
Forget = Annotated[str, typer.Option("--forget", metavar="NAME", help="Undo its enrolment.")]
Reason = Annotated[str, typer.Option("--reason", help="With --retire and --off: printed at every stop.")]
Listed = Annotated[bool, typer.Option("--list", help="Show the enrolled robots with network and exemption.")]

UNDONE = "It must answer again as soon as it is heard with its enrolled key."


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one enrolled robot: ``retired``, ``off`` or ``forget``."""

    action: str
    name: str
    reason: str


def change_of(*, retire: str, off: str, forget: str, reason: str) -> Change | None:
    """Return the change that the options ask for, or None.

    Raises:
        CliError: two of them, or a reason for none.
        ValidationError: a name or a reason out of its domain.
    """
    stated = [
        Change(action, text(flag, name, longest=256), reason)
        for action, flag, name in ((RETIRED, "--retire", retire), (OFF, "--off", off), ("forget", "--forget", forget))
        if name
    ]
    if len(stated) > 1:
        raise CliError("--retire, --off and --forget are one at a time.", Exit.USAGE)
    text("--reason", reason, longest=REASON_MAX, empty=True)
    if reason and (not stated or stated[0].action == "forget"):
        raise CliError("--reason goes with --retire or --off.", Exit.USAGE)
    return stated[0] if stated else None


def apply(screen: Screen, change: Change, tenant: str) -> None:
    """Carry out a change of an enrolled robot, and record it in the audit.

    Raises:
        CliError: it is not enrolled, or the file cannot be used.
    """
    file, who = EnrolledKeys(), operator()
    try:
        known = file.robots()
        own = local_name(tenant, change.name)
        name = own if own in known else change.name
        if name not in known:
            there = f" Enrolled: {', '.join(sorted(known))}." if known else " No robot is enrolled."
            raise CliError(plain(f"{shown(change.name)} is not enrolled.{there}", 2000), robots={})
        if change.action == "forget":
            file.forget(name)
        else:
            file.exempt(name, Exemption(change.action, who, change.reason, time.time()))
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was changed: {exc}") from exc
    facts = {"who": who, "reason": change.reason, "fingerprint": fingerprint(known[name].key)}
    log_safety_event(f"enrolment_{'forgotten' if change.action == 'forget' else change.action}", name, facts)
    screen.data({"status": "success", "robot": name, "action": change.action, "by": who, "reason": change.reason})
    if change.action == "forget":
        screen.say(f"{name} is not enrolled any more: its answers are not checked, and no stop waits for it by name.")
    else:
        screen.say(f"{name} is {change.action}: every stop prints that, and waits for it no more. {UNDONE}")
        if any(each.alive and local_name(each.network.tenant, each.name) == name for each in sightings().read()[0]):
            screen.say(f"A process of this machine serves {name} now: until that ends, it must answer.", "yellow")


def show_enrolled(screen: Screen) -> None:
    """Show the enrolled robots.

    Raises:
        CliError: the file cannot be used.
    """
    try:
        robots = EnrolledKeys().robots()
    except (KeyFileError, OSError) as exc:
        raise CliError(f"The enrolled robots cannot be read: {exc}") from exc
    rows = ((name, _state(each), _networks(each), fingerprint(each.key)) for name, each in sorted(robots.items()))
    shown_robots = table("", ("robot", "", "network", "fingerprint"), rows)
    # It is compared and copied, so it stays whole.
    shown_robots.columns[-1].no_wrap = True
    screen.show(shown_robots)
    screen.data({"status": "success", "robots": {name: _facts(each) for name, each in sorted(robots.items())}})
    if not robots:
        screen.say("No robot is enrolled: a stop waits for every robot that was heard.")


def _state(robot: EnrolledRobot) -> Any:
    exempt = robot.exemption
    if exempt is None:
        return label("must answer", "green")
    why = f": {exempt.reason}" if exempt.reason else ""
    return label(plain(f"{exempt.state} since {utc(exempt.at)} by {exempt.by}{why}", 400), "yellow")


def _networks(robot: EnrolledRobot) -> str:
    return "; ".join(described(each) for each in robot.networks) or "every one (enrolled by an earlier release)"


def _facts(robot: EnrolledRobot) -> dict[str, Any]:
    exempt = robot.exemption
    return {
        "fingerprint": fingerprint(robot.key),
        "networks": [each.text for each in robot.networks],
        "exempt": exempt and {"state": exempt.state, "by": exempt.by, "reason": exempt.reason, "at": exempt.at},
    }
