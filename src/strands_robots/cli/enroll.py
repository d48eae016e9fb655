"""``enroll``: learn the public keys of robots, so that no other answers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

from strands_robots.audit import log_safety_event
from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.enrolled import Forget, Listed, Off, Reason, Retire, apply, change_of, show_enrolled
from strands_robots.cli.lockout_report import LockoutReport
from strands_robots.cli.network import Network, describe
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.cli.resume import ask_mesh, ask_robots, lockable_robots, operator
from strands_robots.safety import ed25519
from strands_robots.safety.consoles import enrolled_consoles
from strands_robots.safety.identity import DEFAULT_TENANT, EnrolledKeys, KeyFileError, fingerprint, local_name
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster_report import CELL_MAX
from strands_robots.safety.statements import Purpose, distrust, own_key
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
            apply(screen, change, DEFAULT_TENANT if on_mesh else network.stated_tenant)
        return
    if console:
        _enroll_console(screen, console)
        return
    wanted = [device_id("DEVICE", each) for each in devices or []]
    seconds = number("--timeout", timeout, above=0, high=60)
    _enroll_robots(screen, network, wanted, seconds, replace=replace, on_mesh=on_mesh)


def _enroll_robots(
    screen: Screen, network: Network, wanted: list[str], seconds: float, *, replace: bool, on_mesh: bool
) -> None:
    reports, key, where = (_on_mesh if on_mesh else _on_fleet)(network, wanted, seconds)
    tenant = key.tenant
    if not reports:
        raise CliError(f"No robot answered. {where}", Exit.SILENT, devices={})
    keys = {each.name: own_key(Purpose.LOCKOUT_STATE, each.name, _statement(each.facts)) for each in reports}
    problems = {each.name: each.problem for each in reports}
    try:
        file = EnrolledKeys()
        known = file.load()
        outcome: dict[str, tuple[str, str]] = {}
        fresh: dict[str, bytes] = {}
        stated = {local_name(tenant, each.name): _signed_cell(each, keys[each.name]) for each in reports}
        cells = {name: cell for name, cell in stated.items() if cell is not None}
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
        undone = file.enroll(fresh, replace=replace, network=key, cells=cells)
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was enrolled: {exc}") from exc
    for local, exempt in undone.items():
        log_safety_event("exemption_undone", local, {"was": exempt.state, "by": exempt.by, "who": operator()})
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


def _on_fleet(network: Network, wanted: list[str], seconds: float) -> tuple[list[LockoutReport], NetworkKey, str]:
    from strands_robots.device_connect.enrollment import network_of  # noqa: PLC0415 - loaded when a network is used

    with network.fleet() as fleet:
        reports = ask_robots(fleet, wanted or lockable_robots(fleet, seconds), seconds, signed=True)
        return reports, network_of(fleet.link), describe(fleet.link)


def _on_mesh(network: Network, wanted: list[str], seconds: float) -> tuple[list[LockoutReport], NetworkKey, str]:
    from strands_robots.mesh import session  # noqa: PLC0415 - loaded when a network is used

    return ask_mesh(network, seconds, wanted), session.network(), "It was looked for on the native mesh."


def _signed_cell(report: LockoutReport, key: bytes | None) -> str | None:
    """Return the cell that a robot signed within the minute; None is in every cell.

    An unsigned one may be a stranger's, which would take the robot out of later stops of its cell.
    """
    statement = _statement(report.facts)
    cell = statement.get("cell")
    if key is None or not isinstance(cell, str) or len(cell) > CELL_MAX:
        return None
    return None if distrust(Purpose.LOCKOUT_STATE, report.name, statement, key, {}) else cell


def _statement(facts: Mapping[str, object]) -> Mapping[str, object]:
    statement = facts.get("statement")
    return statement if isinstance(statement, Mapping) else {}
