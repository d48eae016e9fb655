"""``enroll``: learn the public keys of robots, so that no other answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from strands_robots.cli.app import Timeout
from strands_robots.cli.network import Network, say_missing
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.lockouts import (
    FORGET,
    Enrolled,
    Enrolment,
    ask_lockouts,
    by_robot,
    change_enrolment,
    enroll_all,
    served_here,
)
from strands_robots.safety import ed25519
from strands_robots.safety.identity import (
    DEFAULT_TENANT,
    OFF,
    RETIRED,
    EnrolledKeys,
    EnrolledRobot,
    KeyFileError,
    enrolled_consoles,
    fingerprint,
)
from strands_robots.safety.lockout import utc
from strands_robots.safety.roster import described
from strands_robots.utils import identifier, number, operator, shown, text

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


COMPARE = "Compare each with the fingerprint that `strands-robots doctor` shows at the robot's own machine."


def enroll(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str] | None, typer.Argument(metavar="DEVICE...", help="Which; else all found.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Accept a robot's new key, or its new network.")] = False,
    console: Annotated[str, typer.Option(help="Let a console elsewhere move hardware: its `keys console`.")] = "",
    retire: Retire = "",
    off: Off = "",
    forget: Forget = "",
    reason: Reason = "",
    listed: Listed = False,
    timeout: Timeout = 2.0,
) -> None:
    """Keep the public keys of robots: from then on only a signed answer counts."""
    change = change_of(retire=retire, off=off, forget=forget, reason=reason)
    if change is not None or listed:
        if devices or console or replace or (change is not None and listed):
            raise CliError("--list, --retire, --off and --forget go with no other.", Exit.USAGE)
        if change is None:
            show_enrolled(screen)
        else:
            apply(screen, change, DEFAULT_TENANT if network.mesh else network.stated.stated_tenant)
        return
    if console:
        _enroll_console(screen, console)
        return
    wanted = [identifier("DEVICE", each) for each in devices or []]
    seconds = number("--timeout", timeout, above=0, high=60)
    _enroll_robots(screen, network, wanted, seconds, replace=replace)


def _enroll_robots(screen: Screen, network: Network, wanted: list[str], seconds: float, *, replace: bool) -> None:
    with network.joined() as there:
        reports = ask_lockouts(there, seconds, robots=wanted, look_s=seconds, signed=True)
        if not by_robot(reports):
            raise CliError(f"No robot answered. {there.reach}", Exit.SILENT, devices={}, absent=there.missing)
        try:
            outcome = enroll_all(reports, replace=replace)
        except (KeyFileError, OSError) as exc:
            raise CliError(f"Nothing was enrolled: {exc}") from exc
    absent = Enrolment(Enrolled.NO_KEY, said="no such robot is in reach")
    outcome |= {name: absent for name in wanted if name not in outcome}
    say_missing(screen, there)
    styles = {Enrolled.CHANGED_KEY: "bold red", Enrolled.TWO_KEYS: "bold red", Enrolled.NO_KEY: "yellow"}
    rows = (
        (name, label(each.outcome.value, styles.get(each.outcome, "green")), each.fingerprint, each.said)
        for name, each in outcome.items()
    )
    screen.show(table("", ("robot", "", "fingerprint", "what it said"), rows))
    facts = {
        name: {"outcome": each.outcome.value, "fingerprint": each.fingerprint, "said": each.said}
        for name, each in outcome.items()
    }
    several = [name for name, each in outcome.items() if each.outcome is Enrolled.TWO_KEYS]
    if several:
        raise CliError(
            plain(
                f"ALARM: {', '.join(several)} shows another key on each network: there are two robots of that id. Give "
                "one of them another id; --mesh enrolls the one on the mesh.",
                2000,
            ),
            devices=facts,
        )
    changed = [name for name, each in outcome.items() if each.outcome is Enrolled.CHANGED_KEY]
    if changed:
        raise CliError(
            plain(
                f"ALARM: {', '.join(changed)} shows another key than the enrolled one: it was set up anew, or another "
                f"machine answers in its name. If you know that it was set up anew: strands-robots enroll --replace.",
                2000,
            ),
            devices=facts,
        )
    if not any(each.outcome in (Enrolled.NEW, Enrolled.KNOWN) for each in outcome.values()):
        raise CliError("No robot showed a key.", Exit.SILENT, devices=facts)
    screen.data({"status": "success", "devices": facts, "absent": there.missing})
    screen.say(COMPARE)


def _enroll_console(screen: Screen, text: str) -> None:
    """Keep the key of a console on another machine, for the robots of this one."""
    public = ed25519.decode(text, 32)
    if public is None:
        raise CliError(
            f"--console must be the key that `strands-robots keys console` prints there, not {shown(text)}.", Exit.USAGE
        )
    mark = fingerprint(public)
    try:
        enrolled_consoles().enroll({f"console-{mark}": public})
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was enrolled: {exc}") from exc
    screen.data({"status": "success", "console": mark})
    screen.say(
        f"Enrolled the console {mark}: on the mesh it may move this user's robots, with their approval.", "green"
    )
