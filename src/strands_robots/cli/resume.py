"""Permissions: ``resume`` and ``lockout`` after an e-stop, ``grant`` of a motion."""

from __future__ import annotations

import getpass
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.lockout_report import LockoutReport
from strands_robots.cli.network import Network, describe, mesh_peer, temporary_mesh_id
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.cli.readiness import state_problem
from strands_robots.cli.resume_mesh import ask_peers, lockable_peers, resume_peers
from strands_robots.envelope import Envelope, text_of
from strands_robots.safety.approval import GRANT_S, Grants, state_dir
from strands_robots.safety.clearance import clear_here
from strands_robots.safety.identity import KeyFileError
from strands_robots.safety.lockout import OVERFLOW, Lockout, utc
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.persistence import LockoutStore, StoredLockout
from strands_robots.safety.resume import sign
from strands_robots.safety.statements import Purpose, distrust
from strands_robots.safety.unheard import Unheard, unheard_now, unheard_since
from strands_robots.tools.mesh_roster import mesh_network
from strands_robots.tools.networks import discover
from strands_robots.utils import device_id, number

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient

THEN = "They move again when they get a new command."


def register(app: typer.Typer) -> None:
    """Add the three commands to the application."""
    command(app, "resume", network=True)(resume)
    command(app, "lockout", network=True)(lockout)
    command(app, "grant")(grant)


def resume(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str] | None, typer.Argument(metavar="DEVICE...", help="With --local: which.")] = None,
    key: Annotated[Path | None, typer.Option("--key", help="The operator's key; signs for every lockout.")] = None,
    targets: Annotated[
        list[str] | None, typer.Option("--targets", help="With --key: which (repeat, or commas).")
    ] = None,
    passphrase_file: PassphraseFile = None,
    local: Annotated[bool, typer.Option("--local", help="Robots of this machine, without a key; audited.")] = False,
    timeout: Timeout = 5.0,
    on_mesh: OnMesh = False,
) -> None:
    """Free locked robots: by the operator's key over the network, or here by --local. It starts no motion.

    Each emergency stop leaves a lockout with its id as epoch. A resume names the epochs of the robot, so that it never
    frees one from a later stop.
    """
    if local == (key is not None):
        raise CliError("resume takes --key FILE, or --local at the robot's own machine.", Exit.USAGE)
    names = [part for each in (*(devices or []), *(targets or [])) for part in each.split(",") if part]
    wanted = [device_id("DEVICE", each) for each in names]
    if key is None:
        _clear_locally(screen, wanted)
        return
    seconds = number("--timeout", timeout, above=0, high=60)
    signer = signing_key(key, passphrase_file)
    if on_mesh:
        network.use_mesh()
        _report(screen, *_resume_on_mesh(screen, wanted, signer, seconds), THEN)
        return
    from strands_robots.device_connect.enrollment import network_of  # noqa: PLC0415 - the network is loaded when it is used

    with network.fleet() as fleet:
        asked = ask_robots(fleet, dict.fromkeys([*wanted, *lockable_robots(fleet)]), seconds)
        if not asked:
            raise CliError(f"No robot answered. {describe(fleet.link)}", Exit.SILENT, devices={})
        unheard = _say_unheard(screen, asked, network_of(fleet.link))
        found = [each for each in asked if not wanted or each.name in wanted]
        outcome = resume_robots(fleet, found, signer, seconds)
    _report(screen, outcome, unheard, THEN)


def lockout(
    screen: Screen,
    network: Network,
    *,
    local: Annotated[bool, typer.Option("--local", help="Only this machine's lockout file.")] = False,
    timeout: Timeout = 2.0,
    on_mesh: OnMesh = False,
) -> None:
    """List locked robots, since when and by whom: live ones, and those in this machine's lockout file.

    The epoch of a lockout is the id of the emergency stop that left it; a resume names it.
    """
    seconds = number("--timeout", timeout, above=0, high=60)
    stored, live, note, stale = _stored_lockouts(), list[LockoutReport](), "", ""
    if not local:
        try:
            if on_mesh:
                live = ask_mesh(network, seconds)
            else:
                with network.fleet() as fleet:
                    live = ask_robots(fleet, lockable_robots(fleet, seconds), seconds)
                stale = fleet.stale
            note = "" if live else "No robot answered on the network. "
        except CliError as failure:
            if failure.code is Exit.USAGE:
                raise
            note = f"{failure.reason} "
    answered = {each.name for each in live if not each.problem}
    cells = [row for each in live for row in _lockout_rows(each.name, each.lockouts)]
    # The answer of a live robot outranks the file.
    for name, lockouts in stored.items():
        cells += [] if name in answered else _lockout_rows(f"{name} (in this machine's file)", lockouts)
    screen.data(
        {
            "status": "success",
            "live": {
                each.name: {
                    "locked": None if each.problem else bool(each.lockouts),
                    "holds": [lockout.fields() for lockout in each.lockouts],
                }
                for each in live
            },
            "kept": {name: [lockout.fields() for lockout in lockouts] for name, lockouts in stored.items()},
            "stale": stale,
        }
    )
    if cells:
        screen.show(table("", ("robot", "locked"), cells))
    for each in live:
        if each.problem:
            screen.say(f"{each.name}: {each.problem}", "yellow")
    free = [each.name for each in live if not each.lockouts and not each.problem]
    result = f"Free: {', '.join(free)}." if free else "" if cells else "No lockout is known."
    if note or result:
        screen.say(f"{note}{result}".strip())


def grant(
    screen: Screen,
    what: Annotated[str, typer.Argument(metavar="VERB@PEER", help="Such as execute@arm-1.")],
    seconds: Annotated[float, typer.Option("--for", help="Seconds for which the grant is valid.")] = GRANT_S,
    caller: Annotated[str, typer.Option("--caller", help="The only caller that it is for.")] = "",
) -> None:
    """Approve one motion of real hardware, once; run it on the robot's own machine.

    A caller's name is what it says it is, but on a mesh with certificates: there its certificate has to prove it.
    """
    verb, at, peer = what.partition("@")
    if not (verb and at and peer):
        raise CliError(f"grant takes VERB@PEER, such as execute@arm-1, not {what!r}.", Exit.USAGE)
    Grants(state_dir() / "grants").grant(verb, peer, seconds, caller=caller)
    screen.data({"status": "success", "verb": verb, "peer": peer, "seconds": seconds, "caller": caller})
    whose = f" by {caller}" if caller else ""
    screen.say(f"Granted: {verb} on {peer}{whose}, once, within {seconds:g} s.", "green")


def lockable_robots(fleet: FleetClient, seconds: float = 2.0) -> list[str]:
    """Return the devices on the network that can be locked and resumed."""
    return [peer.id for peer in fleet.peers(seconds) if any(each.get("name") == "resume" for each in peer.functions)]


def ask_robots(
    fleet: FleetClient, names: Iterable[str], seconds: float, *, signed: bool = False
) -> list[LockoutReport]:
    """Ask each robot for its status, many at once and without a thread for each.

    An enrolled robot whose answer is not its own has a ``problem``.

    Args:
        signed: ask every robot to sign its answer, even one that announces no nonce.
    """
    keys = _enrolled(fleet)
    asked = {name: status_question(fleet, name, signed=signed or name in keys) for name in names}
    reports = []
    for name, (answer, took_s) in fleet.call_each(asked, "getStatus", seconds).items():
        if isinstance(answer, Exception):
            reports.append(LockoutReport(name, problem=plain(str(answer), 2000)))
        else:
            reports.append(status_report(name, answer, took_s * 1000, keys.get(name), asked[name]))
    return reports


def ask_mesh(network: Network, seconds: float, wanted: Iterable[str] = ()) -> list[LockoutReport]:
    """Ask these mesh peers for their lockouts, else all that have a robot."""
    network.use_mesh()
    with mesh_peer(None, temporary_mesh_id("console"), "tool") as mesh:
        discover(mesh)
        return ask_peers(mesh, wanted or lockable_peers(mesh), seconds)


def _resume_on_mesh(
    screen: Screen, wanted: list[str], signer: Any, seconds: float
) -> tuple[dict[str, tuple[bool, str]], Unheard]:
    with mesh_peer(None, temporary_mesh_id("console"), "tool") as mesh:
        discover(mesh)
        asked = ask_peers(mesh, [*wanted, *lockable_peers(mesh)], seconds)
        if not asked:
            raise CliError("No robot answered on the mesh of this machine.", Exit.SILENT, devices={})
        unheard = _say_unheard(screen, asked, mesh_network())
        answers = [each for each in asked if not wanted or each.name in wanted]
        silent = {each.name: (False, each.problem) for each in answers if each.problem}
        found = {each.name: each.lockouts for each in answers if not each.problem}
        return resume_peers(mesh, found, signer, seconds) | silent, unheard


def _say_unheard(screen: Screen, asked: list[LockoutReport], network: NetworkKey) -> Unheard:
    """Name the robots of the roster that do not answer, before others move again."""
    unheard = unheard_now(network, {each.name for each in asked if not each.problem})
    _warn(screen, unheard)
    return unheard


def _warn(screen: Screen, unheard: Unheard) -> None:
    if unheard:
        screen.say(plain(str(unheard), 6000), "bold red")


def operator() -> str:
    """Return the login name of the operator at this machine."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


def _stored_lockouts() -> dict[str, tuple[Lockout, ...]]:
    """Return the lockouts in this machine's file, by robot or by its key.

    Raises:
        CliError: the file cannot be read.
    """
    return {each.name or key: each.state.all for key, each in _stored_file().items() if each.state.locked}


def _stored_file() -> dict[str, StoredLockout]:
    try:
        return LockoutStore().load_all()
    except (OSError, ValueError) as exc:
        raise CliError(f"The lockout file of this machine cannot be read, so its robots come up locked: {exc}") from exc


def _enrolled(fleet: FleetClient) -> dict[str, bytes]:
    """Return the enrolled keys of the robots on this network.

    Raises:
        CliError: the keys cannot be used.
    """
    from strands_robots.device_connect.enrollment import enrolled_robots  # noqa: PLC0415 - the network is loaded when it is used

    try:
        return enrolled_robots(fleet.link)
    except (KeyFileError, OSError) as exc:
        raise CliError(f"The enrolled keys cannot be used: {exc}") from exc


def status_question(fleet: FleetClient, name: str, *, signed: bool) -> dict[str, str]:
    """Return the arguments of ``getStatus``: a fresh nonce, by which the robot signs.

    Args:
        signed: ask for the signature in any case; without it only a robot that announces the nonce is asked for it.
    """
    return {"nonce": new_epoch()} if signed or fleet.announces(name, "getStatus", "nonce") else {}


def status_report(
    name: str, answer: Mapping[str, Any], took_ms: float, key: bytes | None, asked: Mapping[str, str]
) -> LockoutReport:
    """Return the lockouts in an answer to getStatus.

    Args:
        key: the enrolled one, or None.
        asked: the arguments of the question, its nonce where the robot is enrolled.
    """
    if "locked" not in answer:
        return LockoutReport(name, problem="it does not report lockouts", facts=answer, round_trip_ms=took_ms)
    rows = answer.get("lockout")
    lockouts = tuple(Lockout.of(each) for each in rows if isinstance(each, Mapping)) if isinstance(rows, list) else ()
    stated = {"locked": answer["locked"], "epochs": [each.epoch for each in lockouts], **asked}
    problem = distrust(Purpose.LOCKOUT_STATE, name, answer.get("statement"), key, stated)
    return LockoutReport(name, () if problem else lockouts, problem, answer, took_ms)


def _scope(lockout: Lockout) -> str:
    return "" if lockout.scope.everything else f" for {lockout.scope}"


def _lockout_rows(name: str, lockouts: Iterable[Lockout]) -> list[tuple[str, str]]:
    """Return two cells for each lockout: time, source and reason; and its epoch."""
    cells: list[tuple[str, str]] = []
    for each in lockouts:
        why = f"{_scope(each)}{f': {each.reason}' if each.reason else ''}"
        cells += [("" if cells else name, f"since {utc(each.at)} by {each.source}{why}"), ("", f"epoch {each.epoch}")]
    return cells


def _clear_locally(screen: Screen, wanted: list[str]) -> None:
    names = wanted or sorted(_stored_lockouts())
    if not names:
        why = state_problem() or "This machine's file has no lockout; name the robots whose process runs here."
        raise CliError(why, devices={})
    unheard = _unheard_here(names)
    _warn(screen, unheard)
    try:
        cleared = clear_here(operator(), names)
    except (OSError, ValueError) as exc:
        raise CliError(f"Nothing was cleared: {exc}") from exc
    outcome = {name: (said.startswith("cleared"), said) for name, said in cleared.items()}
    _report(screen, outcome, unheard, f"Recorded in the audit as cleared by {operator()}.")


def _unheard_here(names: list[str]) -> Unheard:
    """Return who was not heard since, or why that cannot be read."""
    try:
        return unheard_since(names, _stored_file())
    except CliError as unreadable:
        return Unheard(problem=unreadable.reason.rstrip("."))


def resume_robots(
    fleet: FleetClient, found: list[LockoutReport], signer: Any, seconds: float
) -> dict[str, tuple[bool, str]]:
    """Sign and send a resume of every lockout; return each robot's outcome."""
    keys = _enrolled(fleet)
    by_epoch: dict[str, list[str]] = {}
    for robot in found:
        for lockout in robot.lockouts:
            if lockout.epoch != OVERFLOW:
                by_epoch.setdefault(lockout.epoch, []).append(robot.name)
    assertions: dict[str, list[dict[str, Any]]] = {}
    for epoch, names in by_epoch.items():
        for assertion in sign(signer, epoch, names):
            for name in assertion["targets"]:
                assertions.setdefault(name, []).append(assertion)
    outcomes = {robot.name: _before_resume(robot) for robot in found}
    # All robots at once, and the lockouts of each one after the other, until it refuses.
    left = {each.name: assertions.get(each.name, []) for each in found if each.lockouts and not each.problem}
    while sent := {name: waiting[0] for name, waiting in left.items() if waiting}:
        calls = {name: {"assertion": assertion} for name, assertion in sent.items()}
        for name, (answer, _) in fleet.call_each(calls, "resume", seconds).items():
            goes_on, outcomes[name] = _resumed(name, answer, sent[name], keys.get(name))
            left[name] = left[name][1:] if goes_on else []
    return outcomes


def _before_resume(robot: LockoutReport) -> tuple[bool, str]:
    if robot.problem:
        return False, robot.problem
    if not robot.lockouts:
        return True, "was not locked"
    return False, "more stops than it can keep apart; resume --local at its own machine"


def _resumed(
    name: str, answer: Envelope | Exception, assertion: Mapping[str, Any], key: bytes | None
) -> tuple[bool, tuple[bool, str]]:
    """Return True where its next lockout may be resumed, and the outcome."""
    if isinstance(answer, Exception):
        return False, (False, plain(str(answer.args[0] if answer.args else answer), 2000))
    stated = {"status": answer.get("status"), "nonce": assertion["nonce"]}
    stated |= {"locked": answer["locked"]} if "locked" in answer else {}
    problem = distrust(Purpose.RESUME_ANSWER, name, answer.get("statement"), key, stated)
    if problem:
        return False, (False, problem)
    if answer.get("status") != "success":
        return False, (False, f"{text_of(answer)}: its own audit says why")
    return True, (answer.get("locked") is False, text_of(answer))


def _report(screen: Screen, outcome: dict[str, tuple[bool, str]], unheard: Unheard, then: str) -> None:
    marks = {True: label("free", "green"), False: label("LOCKED", "bold red")}
    screen.show(table("", ("robot", "", "what it said"), ((n, marks[ok], said) for n, (ok, said) in outcome.items())))
    devices = {name: {"free": ok, "said": said} for name, (ok, said) in outcome.items()}
    facts = {"devices": devices, "unheard": list(unheard.names), "unheard_problem": unheard.problem}
    locked = [name for name, (ok, _) in outcome.items() if not ok]
    if locked:
        raise CliError(plain(f"Not resumed: {', '.join(locked)}.", 2000), Exit.REFUSED, **facts)
    screen.data({"status": "success", **facts})
    screen.say(then)
