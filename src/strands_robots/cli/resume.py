"""``resume`` and ``lockout``: free robots after an emergency stop, and see who is held, since when and by whom."""

from __future__ import annotations

import getpass
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli import holds
from strands_robots.cli.command import command
from strands_robots.cli.fleet import asked, reached
from strands_robots.cli.network import Network, describe
from strands_robots.cli.output import Exit, Failure, Screen, label, plain, table
from strands_robots.cli.passphrase import PASSPHRASE_FILE, signing_key
from strands_robots.envelope import text_of
from strands_robots.safety.clearance import clear_here
from strands_robots.safety.resume import sign
from strands_robots.utils import device_id, number

if TYPE_CHECKING:
    from strands_robots.cli.holds import Standing
    from strands_robots.device_connect import FleetClient

_WAIT = typer.Option("--timeout", help="Seconds to wait for an answer.")


def register(app: typer.Typer) -> None:
    """Add both commands to the application."""
    command(app, "resume", network=True)(resume)
    command(app, "lockout", network=True)(lockout)


def resume(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str] | None, typer.Argument(metavar="DEVICE...", help="With --local: which.")] = None,
    key: Annotated[Path | None, typer.Option("--key", help="The operator's key; signs for all that is held.")] = None,
    targets: Annotated[
        list[str] | None, typer.Option("--targets", help="With --key: which (repeat, or commas).")
    ] = None,
    passphrase_file: Annotated[Path | None, PASSPHRASE_FILE] = None,
    local: Annotated[bool, typer.Option("--local", help="Robots of this machine, without a key; audited.")] = False,
    timeout: Annotated[float, _WAIT] = 5.0,
) -> None:
    """Free locked robots: by the operator's key over the network, or here by --local. Nothing moves by it."""
    usage = Failure("resume takes --key FILE, or --local at the robot's own machine.", Exit.USAGE)
    if local and key is not None:
        raise usage
    named = [part for each in (*(devices or []), *(targets or [])) for part in each.split(",") if part]
    wanted = [device_id("DEVICE", each) for each in named]
    if local:
        _locally(screen, wanted)
        return
    if key is None:
        raise usage
    seconds = number("--timeout", timeout, above=0, high=60)
    signer = signing_key(key, passphrase_file)
    with reached(network) as fleet:
        found = holds.standing(fleet, wanted or holds.robots(fleet), seconds)
        if not found:
            raise Failure(f"Nobody answered. {describe(fleet.link)}", Exit.SILENT, devices={})
        outcome = _resumed(fleet, found, signer, seconds)
    _report(screen, outcome, "They move again when they are told to, and not before.")


def lockout(
    screen: Screen,
    network: Network,
    *,
    local: Annotated[bool, typer.Option("--local", help="This machine's lockout file alone.")] = False,
    timeout: Annotated[float, _WAIT] = 2.0,
) -> None:
    """Who is locked, since when and by whom: live robots, and what this machine keeps for those that are off."""
    seconds = number("--timeout", timeout, above=0, high=60)
    kept, live, note = holds.on_disk(), [], ""
    if not local:
        try:
            with reached(network) as fleet:
                live = holds.standing(fleet, holds.robots(fleet, seconds), seconds)
            note = "" if live else "Nobody answered on the network. "
        except Failure as failure:
            if failure.code is Exit.USAGE:
                raise
            note = f"{failure.reason} "
    seen = {each.name: each for each in live}
    cells: list[tuple[Any, ...]] = [row for each in live for row in holds.rows(each.name, each.holds)]
    # A robot that is on the network answers for itself.
    away = {name: held for name, held in kept.items() if name not in seen or seen[name].problem}
    cells += [row for name, held in away.items() for row in holds.rows(f"{name} (kept here)", held)]
    screen.data(
        {
            "status": "success",
            "live": {
                each.name: {"locked": _locked(each), "holds": [holds.fields(hold) for hold in each.holds]}
                for each in live
            },
            "kept": {name: [holds.fields(hold) for hold in held] for name, held in kept.items()},
        }
    )
    if cells:
        screen.show(table("", ("robot", "locked"), cells))
    for each in live:
        if each.problem:
            screen.say(f"{each.name}: {each.problem}", "yellow")
    free = [each.name for each in live if not each.holds and not each.problem]
    told = f"Free: {', '.join(free)}." if free else "" if cells else "No lockout is known."
    if note or told:
        screen.say(f"{note}{told}".strip())


def operator() -> str:
    """Who sits at this machine, by its login name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


def _locally(screen: Screen, wanted: list[str]) -> None:
    names = wanted or sorted(holds.on_disk())
    if not names:
        raise Failure("This machine keeps no lockout; name the robots whose process runs here.", devices={})
    try:
        cleared = clear_here(operator(), names)
    except (OSError, ValueError) as exc:
        raise Failure(f"Nothing was cleared: {exc}") from exc
    outcome = {name: (said.startswith("cleared"), said) for name, said in cleared.items()}
    _report(screen, outcome, f"Recorded in the audit as cleared by {operator()}.")


def _resumed(fleet: FleetClient, found: list[Standing], signer: Any, seconds: float) -> dict[str, tuple[bool, str]]:
    """Whether each robot is free now, and what there is to say of it."""
    for_epoch: dict[str, list[str]] = {}
    for each in found:
        for epoch in each.resumable:
            for_epoch.setdefault(epoch, []).append(each.name)
    slips: dict[str, list[dict[str, Any]]] = {}
    for epoch, names in for_epoch.items():
        for assertion in sign(signer, epoch, names):
            for name in assertion["targets"]:
                slips.setdefault(name, []).append(assertion)
    with ThreadPoolExecutor(holds.AT_ONCE) as pool:
        each_one = pool.map(lambda each: _present(fleet, each, slips.get(each.name, []), seconds), found)
        return {each.name: told for each, told in zip(found, each_one, strict=True)}


def _present(fleet: FleetClient, robot: Standing, slips: list[dict[str, Any]], seconds: float) -> tuple[bool, str]:
    if robot.problem:
        return False, robot.problem
    if not robot.holds:
        return True, "was not locked"
    locked, said = True, "more stops than can be told apart; resume --local at its own machine"
    for slip in slips:
        try:
            answer = asked(fleet, robot.name, "resume", {"assertion": slip}, seconds)
        except Failure as failure:
            return False, failure.reason
        if answer.get("status") != "success":
            return False, f"{text_of(answer)}: its own audit says why"
        locked, said = answer.get("locked") is not False, text_of(answer)
    return not locked, said


def _report(screen: Screen, outcome: dict[str, tuple[bool, str]], end: str) -> None:
    marks = {True: label("free", "green"), False: label("LOCKED", "bold red")}
    screen.show(table("", ("robot", "", "what it said"), ((n, marks[ok], said) for n, (ok, said) in outcome.items())))
    devices = {name: {"free": ok, "said": said} for name, (ok, said) in outcome.items()}
    held = [name for name, (ok, _) in outcome.items() if not ok]
    if held:
        raise Failure(plain(f"Not resumed: {', '.join(held)}.", 2000), Exit.REFUSED, devices=devices)
    screen.data({"status": "success", "devices": devices})
    screen.say(end)


def _locked(each: Standing) -> bool | None:
    return None if each.problem else bool(each.holds)
