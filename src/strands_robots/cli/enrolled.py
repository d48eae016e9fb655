"""Options of ``enroll`` that list, exempt and forget enrolled robots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.enrollment import FORGET, change_enrolment, served_here
from strands_robots.safety.identity import (
    OFF,
    RETIRED,
    EnrolledKeys,
    EnrolledRobot,
    KeyFileError,
    fingerprint,
)
from strands_robots.safety.lockout import utc
from strands_robots.safety.roster import described
from strands_robots.utils import operator, text

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
        for action, flag, name in ((RETIRED, "--retire", retire), (OFF, "--off", off), (FORGET, "--forget", forget))
        if name
    ]
    if len(stated) > 1:
        raise CliError("--retire, --off and --forget are one at a time.", Exit.USAGE)
    text("--reason", reason, longest=REASON_MAX, empty=True)
    if reason and (not stated or stated[0].action == FORGET):
        raise CliError("--reason goes with --retire or --off.", Exit.USAGE)
    return stated[0] if stated else None


def apply(screen: Screen, change: Change, tenant: str) -> None:
    """Carry out a change of an enrolled robot, and record it in the audit.

    Raises:
        CliError: it is not enrolled, or the file cannot be used.
    """
    who = operator()
    try:
        name = change_enrolment(change.name, change.action, change.reason, tenant=tenant)
    except NoSuchRobotError as exc:
        raise CliError(plain(str(exc), 2000), robots={}) from exc
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was changed: {exc}") from exc
    screen.data({"status": "success", "robot": name, "action": change.action, "by": who, "reason": change.reason})
    if change.action == FORGET:
        screen.say(f"{name} is not enrolled any more: its answers are not checked, and no stop waits for it by name.")
    else:
        screen.say(f"{name} is {change.action}: every stop prints that, and waits for it no more. {UNDONE}")
        if served_here(name):
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
