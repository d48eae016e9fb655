"""Permissions: ``resume``, ``lockout``, ``grant``, ``take``; ``enroll`` of keys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from strands_robots.cli.app import Timeout
from strands_robots.cli.keys import PassphraseFile, signing_key
from strands_robots.cli.network import Network, answering, say_missing
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table
from strands_robots.cli.readiness import state_problem
from strands_robots.envelope import is_error, text_of
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.fleet.lockouts import (
    FORGET,
    Enrolled,
    Enrolment,
    ask_lockouts,
    by_robot,
    change_enrolment,
    enroll_all,
    resume_all,
    served_here,
    unheard_in,
)
from strands_robots.safety import ed25519
from strands_robots.safety.authorization import GRANT_S, Grants
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
from strands_robots.safety.lockout import Lockout, utc
from strands_robots.safety.persistence import LockoutStore, StoredLockout
from strands_robots.safety.resume import NOT_LOCKED, clear_here, sign_take
from strands_robots.safety.roster import described
from strands_robots.safety.stop_notes import Unheard, unheard_since
from strands_robots.state_files import state_dir
from strands_robots.utils import identifier, number, operator, shown, text

THEN = "They move again when they get a new command."


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
) -> None:
    """Free locked robots: by the operator's key over the network, or here by --local. It starts no motion.

    Each emergency stop leaves a lockout with its id as epoch. A resume names the epochs of the robot, so that it never
    frees one from a later stop.
    """
    if local == (key is not None):
        raise CliError("resume takes --key FILE, or --local at the robot's own machine.", Exit.USAGE)
    names = [part for each in (*(devices or []), *(targets or [])) for part in each.split(",") if part]
    wanted = [identifier("DEVICE", each) for each in names]
    if key is None:
        _clear_locally(screen, wanted)
        return
    seconds = number("--timeout", timeout, above=0, high=60)
    signer = signing_key(key, passphrase_file)
    with network.joined() as there:
        reports = ask_lockouts(there, seconds, besides=wanted)
        found = by_robot(reports)
        if not found:
            raise CliError(f"No robot answered. {there.reach}", Exit.SILENT, devices={}, absent=there.missing)
        # They are named before others move again.
        unheard = unheard_in(reports)
        _warn(screen, unheard)
        outcome = dict.fromkeys((name for name in wanted if name not in found), (False, "no such robot is in reach"))
        if len(outcome) < len(wanted) or not wanted:
            outcome |= resume_all(reports, signer, seconds, robots=[name for name in wanted if name in found])
    say_missing(screen, there)
    _report(screen, outcome, unheard, THEN, absent=there.missing)


def lockout(
    screen: Screen,
    network: Network,
    *,
    local: Annotated[bool, typer.Option("--local", help="Only this machine's lockout file.")] = False,
    timeout: Timeout = 2.0,
) -> None:
    """List locked robots, since when and by whom: live ones, and those in this machine's lockout file.

    The epoch of a lockout is the id of the emergency stop that left it; a resume names it.
    """
    seconds = number("--timeout", timeout, above=0, high=60)
    stored, live, note, stale = _stored_lockouts(), list[LockoutReport](), "", ""
    missing: dict[str, str] = {}
    if not local:
        try:
            with network.joined() as there:
                live = list(by_robot(ask_lockouts(there, seconds, look_s=seconds)).values())
                stale = there.stale
            missing = there.missing
            say_missing(screen, there)
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
                    "locked": True if each.lockouts else None if each.problem else False,
                    "holds": [lockout.fields() for lockout in each.lockouts],
                }
                for each in live
            },
            "kept": {name: [lockout.fields() for lockout in lockouts] for name, lockouts in stored.items()},
            "stale": stale,
            "absent": missing,
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


def _warn(screen: Screen, unheard: Unheard) -> None:
    if unheard:
        screen.say(plain(str(unheard), 6000), "bold red")


def _lockout_rows(name: str, lockouts: Iterable[Lockout]) -> list[tuple[str, str]]:
    """Return two cells for each lockout: time, source and reason; and its epoch."""
    cells: list[tuple[str, str]] = []
    for each in lockouts:
        scope = "" if each.scope.everything else f" for {each.scope}"
        why = f"{scope}{f': {each.reason}' if each.reason else ''}"
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
    outcome = {
        name: (None if said == NOT_LOCKED else said.startswith("cleared"), said) for name, said in cleared.items()
    }
    _report(screen, outcome, unheard, f"Recorded in the audit as cleared by {operator()}.")


def _unheard_here(names: list[str]) -> Unheard:
    """Return who was not heard since, or why that cannot be read."""
    try:
        return unheard_since(names, _stored_file())
    except CliError as unreadable:
        return Unheard(problem=unreadable.reason.rstrip("."))


def _report(
    screen: Screen, outcome: Mapping[str, tuple[bool | None, str]], unheard: Unheard, then: str, **more: object
) -> None:
    marks = {True: label("free", "green"), False: label("LOCKED", "bold red"), None: ""}
    screen.show(table("", ("robot", "", "what it said"), ((n, marks[ok], said) for n, (ok, said) in outcome.items())))
    devices = {name: {"free": ok, "said": said} for name, (ok, said) in outcome.items()}
    facts = {"devices": devices, "unheard": list(unheard.names), "unheard_problem": unheard.problem, **more}
    locked = [name for name, (ok, _) in outcome.items() if ok is False]
    if locked:
        raise CliError(plain(f"Not resumed: {', '.join(locked)}.", 2000), Exit.REFUSED, **facts)
    not_locked = [name for name, (ok, _) in outcome.items() if ok is None]
    if not_locked:
        raise CliError(plain(f"Nothing is locked here: {', '.join(not_locked)}.", 2000), Exit.REFUSED, **facts)
    screen.data({"status": "success", **facts})
    screen.say(then)


def take(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str, typer.Argument(help="The robot's id.")],
    key: Annotated[Path | None, typer.Option("--key", help="The operator's key; a simulation may need none.")] = None,
    passphrase_file: PassphraseFile = None,
    robot: Annotated[str, typer.Option("--robot", help="Which robot of a simulated world.")] = "",
    reason: Annotated[
        str, typer.Option("--reason", help="Told to the one who loses control.")
    ] = "an operator took over",
    timeout: Timeout = 5.0,
) -> None:
    """Take control of a robot: its motion is halted, and only you may move it then."""
    name, seconds = identifier("DEVICE", device), number("--timeout", timeout, above=0, high=60)
    signer = None if key is None else signing_key(key, passphrase_file)
    which: dict[str, object] = {"robot_name": robot} if robot else {}
    with network.joined() as there, answering(there, name, "takeControl"):
        place = there.of(name, "takeControl", moves=True)
        before = place.call(name, "getControl", which, seconds)
        if is_error(before):
            raise CliError(plain(text_of(before), 2000), Exit.REFUSED)
        asked = {"reason": reason, **which}
        if signer is not None:
            asked["assertion"] = sign_take(signer, f"{name}/{robot}" if robot else name, int(before["epoch"]))
        answer = place.call(name, "takeControl", asked, seconds)
    if is_error(answer):
        raise CliError(plain(text_of(answer), 2000), Exit.REFUSED)
    screen.data(answer)
    screen.say(f"{name}: {plain(text_of(answer), 400)}")
    screen.say(f"lease_id {plain(str(answer['lease_id']), 64)}")


REASON_MAX = 200

Retire = Annotated[str, typer.Option("--retire", metavar="NAME", help="It is gone for good: no stop waits for it.")]
Off = Annotated[str, typer.Option("--off", metavar="NAME", help="It is switched off: no stop waits for it.")]
Forget = Annotated[str, typer.Option("--forget", metavar="NAME", help="Undo its enrolment.")]
Reason = Annotated[str, typer.Option("--reason", help="With --retire and --off: printed at every stop.")]
Listed = Annotated[bool, typer.Option("--list", help="Show the enrolled robots with network and exemption.")]

UNDONE = "It must answer again as soon as it is heard with its enrolled key."


def _change_of(*, retire: str, off: str, forget: str, reason: str) -> tuple[str, str] | None:
    """Return the change that the options ask for, and the robot's name; or None.

    Raises:
        CliError: two of them, or a reason for none.
        ValidationError: a name or a reason out of its domain.
    """
    stated = [
        (action, text(flag, name, longest=256))
        for action, flag, name in ((RETIRED, "--retire", retire), (OFF, "--off", off), (FORGET, "--forget", forget))
        if name
    ]
    if len(stated) > 1:
        raise CliError("--retire, --off and --forget are one at a time.", Exit.USAGE)
    text("--reason", reason, longest=REASON_MAX, empty=True)
    if reason and (not stated or stated[0][0] == FORGET):
        raise CliError("--reason goes with --retire or --off.", Exit.USAGE)
    return stated[0] if stated else None


def _apply(screen: Screen, action: str, robot: str, reason: str, tenant: str) -> None:
    """Carry out a change of an enrolled robot, and record it in the audit.

    Raises:
        CliError: it is not enrolled, or the file cannot be used.
    """
    try:
        name = change_enrolment(robot, action, reason, tenant=tenant)
    except NoSuchRobotError as exc:
        raise CliError(plain(str(exc), 2000), robots={}) from exc
    except (KeyFileError, OSError) as exc:
        raise CliError(f"Nothing was changed: {exc}") from exc
    screen.data({"status": "success", "robot": name, "action": action, "by": operator(), "reason": reason})
    if action == FORGET:
        screen.say(f"{name} is not enrolled any more: its answers are not checked, and no stop waits for it by name.")
    else:
        screen.say(f"{name} is {action}: every stop prints that, and waits for it no more. {UNDONE}")
        if served_here(name):
            screen.say(f"A process of this machine serves {name} now: until that ends, it must answer.", "yellow")


def _show_enrolled(screen: Screen) -> None:
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
    change = _change_of(retire=retire, off=off, forget=forget, reason=reason)
    if change is not None or listed:
        if devices or console or replace or (change is not None and listed):
            raise CliError("--list, --retire, --off and --forget go with no other.", Exit.USAGE)
        if change is None:
            _show_enrolled(screen)
        else:
            _apply(screen, *change, reason, DEFAULT_TENANT if network.mesh else network.stated.stated_tenant)
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
