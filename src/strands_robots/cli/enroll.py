"""``enroll``: learn the public keys of robots, so that no other answers."""

from __future__ import annotations

from typing import Annotated

import typer

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.enrolled import Forget, Listed, Off, Reason, Retire, apply, change_of, show_enrolled
from strands_robots.cli.network import Network, say_missing
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.fleet.all_lockouts import ask_lockouts, by_robot, enroll_all
from strands_robots.fleet.enrollment import Enrolled, Enrolment
from strands_robots.safety import ed25519
from strands_robots.safety.identity import DEFAULT_TENANT, KeyFileError, enrolled_consoles, fingerprint
from strands_robots.utils import identifier, number, shown

COMPARE = "Compare each with the fingerprint that `strands-robots doctor` shows at the robot's own machine."


def register(app: typer.Typer) -> None:
    """Add ``enroll`` to the application."""
    command(app, "enroll", network=True)(enroll)


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
    on_mesh: OnMesh = False,
) -> None:
    """Keep the public keys of robots: from then on only a signed answer counts."""
    change = change_of(retire=retire, off=off, forget=forget, reason=reason)
    if change is not None or listed:
        if devices or console or replace or (change is not None and listed):
            raise CliError("--list, --retire, --off and --forget go with no other.", Exit.USAGE)
        if change is None:
            show_enrolled(screen)
        else:
            apply(screen, change, DEFAULT_TENANT if on_mesh else network.stated.stated_tenant)
        return
    if console:
        _enroll_console(screen, console)
        return
    wanted = [identifier("DEVICE", each) for each in devices or []]
    seconds = number("--timeout", timeout, above=0, high=60)
    _enroll_robots(screen, network, wanted, seconds, replace=replace, on_mesh=on_mesh)


def _enroll_robots(
    screen: Screen, network: Network, wanted: list[str], seconds: float, *, replace: bool, on_mesh: bool
) -> None:
    with network.joined(on_mesh=on_mesh) as there:
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
