"""``enroll``: learn the public keys of robots, so that no other answers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.lockout_report import LockoutReport
from strands_robots.cli.network import Network, describe
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.cli.resume import ask_mesh, ask_robots, lockable_robots
from strands_robots.safety import ed25519
from strands_robots.safety.consoles import enrolled_consoles
from strands_robots.safety.identity import DEFAULT_TENANT, EnrolledKeys, KeyFileError, fingerprint, local_name
from strands_robots.safety.statements import Purpose, own_key
from strands_robots.utils import device_id, number, shown

COMPARE = "Compare each with the fingerprint that `strands-robots doctor` shows at the robot's own machine."


def register(app: typer.Typer) -> None:
    """Add ``enroll`` to the application."""
    command(app, "enroll", network=True)(enroll)


def enroll(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str] | None, typer.Argument(metavar="DEVICE...", help="Which; else all found.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Accept the new key of a robot set up anew.")] = False,
    console: Annotated[str, typer.Option(help="Let a console elsewhere move hardware: its `keys console`.")] = "",
    timeout: Timeout = 2.0,
    on_mesh: OnMesh = False,
) -> None:
    """Keep the public keys of robots: from then on only a signed answer counts."""
    if console:
        _enroll_console(screen, console)
        return
    wanted = [device_id("DEVICE", each) for each in devices or []]
    seconds = number("--timeout", timeout, above=0, high=60)
    reports, tenant, where = (_on_mesh if on_mesh else _on_fleet)(network, wanted, seconds)
    if not reports:
        raise CliError(f"No robot answered. {where}", Exit.SILENT, devices={})
    keys = {each.name: own_key(Purpose.LOCKOUT_STATE, each.name, _statement(each.facts)) for each in reports}
    problems = {each.name: each.problem for each in reports}
    try:
        file = EnrolledKeys()
        known = file.load()
        outcome: dict[str, tuple[str, str]] = {}
        fresh: dict[str, bytes] = {}
        for name, public in keys.items():
            local = local_name(tenant, name)
            if public is None:
                outcome[name] = (
                    "no key",
                    problems[name] or "it shows no key; it runs another version, or its log says why",
                )
            elif known.get(local, public) != public and not replace:
                outcome[name] = "CHANGED KEY", f"enrolled is {fingerprint(known[local])}; nothing was changed"
            else:
                outcome[name] = "known" if known.get(local) == public else "enrolled", ""
                fresh[local] = public
        file.enroll(fresh, replace=replace)
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was enrolled: {exc}") from exc
    prints = {name: fingerprint(public) if public else "" for name, public in keys.items()}
    styles = {"CHANGED KEY": "bold red", "no key": "yellow"}
    rows = (
        (name, label(mark, styles.get(mark, "green")), prints[name], said) for name, (mark, said) in outcome.items()
    )
    screen.show(table("", ("robot", "", "fingerprint", "what it said"), rows))
    facts = {
        name: {"outcome": mark, "fingerprint": prints[name], "said": said} for name, (mark, said) in outcome.items()
    }
    changed = [name for name, (mark, _) in outcome.items() if mark == "CHANGED KEY"]
    if changed:
        raise CliError(
            plain(
                f"ALARM: {', '.join(changed)} shows another key than the enrolled one: it was set up anew, or another "
                f"machine answers in its name. If you know that it was set up anew: strands-robots enroll --replace.",
                2000,
            ),
            devices=facts,
        )
    if not fresh:
        raise CliError("No robot showed a key.", Exit.SILENT, devices=facts)
    screen.data({"status": "success", "devices": facts})
    screen.say(COMPARE)


def _enroll_console(screen: Screen, text: str) -> None:
    """Keep the key of a console on another machine, for the robots of this one."""
    public = ed25519.decode(text, 32)
    if public is None:
        raise CliError(f"--console must be the key that `strands-robots keys console` prints there, not {shown(text)}.")
    mark = fingerprint(public)
    try:
        enrolled_consoles().enroll({f"console-{mark}": public})
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was enrolled: {exc}") from exc
    screen.data({"status": "success", "console": mark})
    screen.say(
        f"Enrolled the console {mark}: on the mesh it may move this user's robots, with their approval.", "green"
    )


def _on_fleet(network: Network, wanted: list[str], seconds: float) -> tuple[list[LockoutReport], str, str]:
    with network.fleet() as fleet:
        reports = ask_robots(fleet, wanted or lockable_robots(fleet, seconds), seconds)
        return reports, fleet.link.tenant, describe(fleet.link)


def _on_mesh(network: Network, wanted: list[str], seconds: float) -> tuple[list[LockoutReport], str, str]:
    return ask_mesh(network, seconds, wanted), DEFAULT_TENANT, "It was looked for on the native mesh."


def _statement(facts: Mapping[str, object]) -> Mapping[str, object]:
    statement = facts.get("statement")
    return statement if isinstance(statement, Mapping) else {}
