"""``stop``: stop one robot, or all. ``estop``: stop and lock every robot."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.keys import PassphraseFile, operator_key, signing_key
from strands_robots.cli.network import Network, near_robots, say_missing
from strands_robots.cli.output import POLL_S, CliError, Exit, Screen, captured_log, label, plain, table
from strands_robots.cli.readiness import meeting_user
from strands_robots.cli.stop_report import (
    LATE_MS,
    exit_code,
    failure,
    outcome_rows,
    progress_rows,
    say_outcome,
    stop_table,
)
from strands_robots.envelope import Envelope, error
from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.all_stops import estop_all, stop_all
from strands_robots.fleet.callers import SOURCE, TOOL
from strands_robots.fleet.fleet_verdict import FleetVerdict, NetworkVerdict
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stop_answers import combined_verdict, not_reached, roster_verdict, stop_outcome
from strands_robots.safety.answers import Progress
from strands_robots.safety.controller import DEADLINE_S
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.serving.stop_arguments import robot_of_world, stop_reason, stop_robot, stop_scope
from strands_robots.utils import ValidationError, device_id, number

LOCKED = "They are locked until they are resumed:"
LOCKED_THERE = "They are locked until they are resumed, at the machine of each robot:"
BY_KEY = "Or from here, once the robots know the key that this makes (docs/safety.md):"
UNKNOWN_KEY = "A robot that does not know that key is resumed at its own machine:"
RESUME_HERE = "strands-robots resume --local"
KEPT_BY_NONE = (
    "No robot answered, so none keeps this stop for one that comes back. Stop it again then, or keep "
    "strands-robots safety-controller open: it tells a robot that comes back."
)
CLAIMED = "Claimed is not proven: no enrolled robot signed it. Enroll robots with strands-robots enroll."


def register(app: typer.Typer) -> None:
    """Add both commands to the application."""
    command(app, "stop", network=True)(stop)
    command(app, "estop", network=True)(estop)


def stop(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str | None, typer.Argument(help="The device's id.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Stop every device that answers.")] = False,
    one: Annotated[str, typer.Option("--robot", help="Stop this robot of DEVICE's world alone.")] = "",
    timeout: Timeout = 5.0,
    on_mesh: OnMesh = False,
) -> None:
    """Stop one robot, or all, on every network.

    Exits with 1 when one did not stop, with 3 when one is silent.
    """
    device, unread = stop_robot("DEVICE", None if everything else device)
    name = robot_of_world({"robot_name": one})[0] if device else ""
    if one and not name:
        unread = unread or "--robot names no robot of a DEVICE's world, so all of it is stopped"
    seconds, unfit = _seconds("--timeout", timeout, 60, 5.0)
    with _stopping(screen, network, on_mesh=on_mesh) as networks:
        if device:
            answers = networks.stop(device, seconds, name)
            _say_ignored(screen, unread, unfit)
            # One robot of a world is named with it: the others may move on.
            _report_one(screen, networks, device, f"{device}/{name}" if name else device, answers)
        else:
            verdict = stop_all(networks, seconds)
            _say_ignored(screen, unread, unfit)
            _report(screen, networks, verdict, _plain_facts)


def estop(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[
        list[str] | None,
        typer.Argument(metavar="DEVICE...", help="Those that must answer. Every robot stops."),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Every robot that can be found must answer; the default.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            help="Stop this robot alone; may be repeated. Without --mesh, bare devices and earlier releases stop, too.",
            metavar="ROBOT",
        ),
    ] = None,
    cell: Annotated[
        str, typer.Option("--cell", help="Stop the robots of this cell, and every robot without a cell.")
    ] = "",
    reason: Annotated[str, typer.Option("--reason", help="Sent to the robots and written to their audit.")] = "",
    source: Annotated[str, typer.Option("--as", help="The source that robots see.")] = SOURCE,
    deadline: Annotated[
        float, typer.Option("--deadline", help="Seconds until a robot without an answer counts as silent.")
    ] = DEADLINE_S,
    key: Annotated[
        Path | None, typer.Option("--key", help="Sign it; then only enrolled robots can confirm it.")
    ] = None,
    passphrase_file: PassphraseFile = None,
    on_mesh: OnMesh = False,
) -> None:
    """Stop every robot and lock it, on every network.

    Exits with 1 when one did not stop, with 3 when one is silent.

    With --only or --cell it is for these robots; where none of them is there, every robot is stopped.

    On Device Connect it is for a tenant, the fleet that --tenant names, default without it. The id of the stop is the
    epoch of the lockout that it leaves; a resume names it.
    """
    reason, cut = stop_reason(reason)
    scope, unread = stop_scope(only, cell)
    seconds, unfit = _seconds("--deadline", deadline, 600, DEADLINE_S)
    source = device_id("--as", source)
    with _stopping(screen, network, on_mesh=on_mesh, source=source) as networks:
        latest: dict[str, Progress] = {}
        pressed = partial(
            estop_all,
            networks,
            reason,
            scope=scope,
            signing_key=None if key is None else signing_key(key, passphrase_file),
            # What is no device's id answers to nothing, so the report has it as silent.
            named=() if everything else tuple(devices or ()),
            deadline_s=seconds,
            on_progress=latest.__setitem__,
        )
        verdict = _watched(screen, networks, pressed, latest) if screen.live else pressed()
        _say_ignored(screen, cut, unread, unfit)
        try:
            _report(screen, networks, verdict, _estop_facts, drawn=screen.live)
        finally:
            # A robot that did not stop is locked all the same.
            locked = {each.network for each in verdict.networks if _locked(each)}
            there = [each for each in networks.stated if each.name in locked]
            if there and all(each.on_this_machine for each in there):
                user = meeting_user(there[0].meeting_port)
                screen.say(LOCKED)
                screen.copyable(f"  sudo -u {user} {RESUME_HERE}" if user else f"  {RESUME_HERE}")
            elif there:
                show_resume(screen, key, f"{' --mesh' if on_mesh else ''}{network.flags}")


@contextmanager
def _stopping(screen: Screen, network: Network, *, on_mesh: bool, source: str | None = None) -> Iterator[Networks]:
    """Make the networks of a stop, which joins them itself."""
    try:
        networks = network.networks(on_mesh=on_mesh, source=TOOL if on_mesh else source)
    except CliError as failure:
        raise CliError(failure.reason, failure.code, stopped=None) from failure
    if not networks.stated:
        raise CliError(f"No network can be joined: {networks.absences}.", Exit.SILENT, stopped=None)
    # The table of a stop names what the log would report.
    with closing(networks), captured_log() if screen.live else nullcontext():
        yield networks


def _say_ignored(screen: Screen, *notes: str) -> None:
    """Say what of a stop's arguments is left out, once the stop has left."""
    for note in filter(None, notes):
        screen.say(f"Ignored: {plain(note, 300)}.", "yellow")


def _seconds(name: str, value: float, most: float, usual: float) -> tuple[float, str]:
    """Return a time in its domain, and a note on one that was not."""
    try:
        return number(name, value, above=0, high=most), ""
    except ValidationError as unfit:
        return usual, f"{str(unfit).rstrip('.')}; it is {usual:g}"


def show_resume(screen: Screen, key: Path | None, flags: str) -> None:
    """Print the command that frees robots of other machines.

    Args:
        screen: where.
        key: the key that signed the stop; it is not an operator's.
        flags: the network's.
    """
    held = next((each for each in (Path("operator.pem"), operator_key()) if each.is_file() and each != key), None)
    if held is not None:
        screen.say(LOCKED)
        screen.copyable(f"  strands-robots resume --key {shlex.quote(str(held.resolve()))}{flags}")
        screen.say(UNKNOWN_KEY)
        screen.copyable(f"  {RESUME_HERE}")
        return
    screen.say(LOCKED_THERE)
    screen.copyable(f"  {RESUME_HERE}")
    screen.say(BY_KEY)
    screen.copyable(f"  strands-robots keys resume {shlex.quote(str(operator_key()))}")


def _watched(
    screen: Screen, networks: Networks, pressed: Callable[[], FleetVerdict], latest: Mapping[str, Progress]
) -> FleetVerdict:
    """Press on a thread that never waits for drawing; draw the answers."""
    verdict: Future[FleetVerdict] = Future()

    def press() -> None:
        try:
            verdict.set_result(pressed())
        except BaseException as exc:  # noqa: BLE001 - raised again by the future
            verdict.set_exception(exc)

    threading.Thread(target=press, name="estop", daemon=True).start()
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    with Live(stop_table({}, "EMERGENCY STOP"), console=screen.out, auto_refresh=False) as live:
        while not wait([verdict], POLL_S).done:
            so_far = dict(latest)
            rows = {name: progress_rows(each) for name, each in so_far.items()}
            live.update(stop_table(rows, _title(so_far, len(networks.stated))), refresh=True)
        shown = _shown(verdict.result())
        live.update(stop_table(_rows(shown), "EMERGENCY STOP"), refresh=True)
    return verdict.result()


def _title(progress: Mapping[str, Progress], networks: int) -> str:
    elapsed_ms = max((each.elapsed_ms for each in progress.values()), default=0.0)
    age = f", pressed {elapsed_ms / 1000:.1f} s ago" if elapsed_ms > LATE_MS else ""
    down = len(progress) == networks and not any(each.link_up for each in progress.values())
    return f"EMERGENCY STOP{age}{': THE LINK IS DOWN' if down else ''}"


def _shown(verdict: FleetVerdict) -> Sequence[NetworkVerdict]:
    """Return the networks to show: one without robots only where it is alone."""
    return verdict.reporting or verdict.networks[:1]


def _rows(shown: Sequence[NetworkVerdict]) -> dict[str, list[tuple[Any, ...]]]:
    return {each.network: outcome_rows(each.outcome) for each in shown if each.outcome is not None}


def _report(
    screen: Screen,
    networks: Networks,
    verdict: FleetVerdict,
    facts: Callable[[Networks, NetworkVerdict], Mapping[str, Any]],
    *,
    drawn: bool = False,
) -> None:
    """Print a stop of all; raise unless every robot that must answer stands still.

    Args:
        screen: where.
        networks: of the stop.
        verdict: of the stop.
        facts: returns what programs read of the first network; robots of others stand under the network's name.
        drawn: the table is on the screen already.
    """
    shown = _shown(verdict)
    rows = _rows(shown)
    estop = bool(verdict.estop_id)
    if not drawn and any(rows.values()):
        screen.show(stop_table(rows, timed=estop))
    failed: list[tuple[Exit, str]] = []
    for each in shown:
        if len(shown) > 1:
            screen.say(f"On {each.network}:")
        if each.outcome is None:
            failed.append((Exit.SILENT, each.sentence))
            continue
        if estop or rows[each.network]:
            say_outcome(screen, each.outcome)
        if estop:
            _warn(screen, each.outcome)
        if (code := exit_code(each.outcome)) is not Exit.OK:
            failed.append((code, _why(networks, each, each.outcome)))
    everywhere = (*verdict.networks, *verdict.unreached)
    first = next((each for each in everywhere if each.network == networks.stated[0].name), everywhere[0])
    known = {**facts(networks, first)}
    for each in verdict.reporting:
        if each is not first:
            known[each.network] = {name: every.stopped for name, every in each.verdicts().items()}
    known["absent"] = networks.missing
    if len(networks.stated) > 1:
        say_missing(screen, networks)
    if failed:
        worst = Exit.REFUSED if any(code is Exit.REFUSED for code, _ in failed) else Exit.SILENT
        raise CliError(plain(" ".join(said for _, said in failed), 2000), worst, **known)
    screen.data({"status": "success", **known})


def _locked(each: NetworkVerdict) -> bool:
    """Return whether a robot answered an emergency stop by which it is locked."""
    if each.outcome is None:
        return False
    report = each.outcome.report
    answered = {*report.stopped, *report.not_stopped, *each.outcome.others.stopped, *each.outcome.others.not_stopped}
    return not answered <= {*each.outcome.not_locked}


def _why(networks: Networks, each: NetworkVerdict, outcome: StopOutcome) -> str:
    """Return one line on a network whose robots are not all known to stand still."""
    said = failure(outcome)
    if each.absent and not outcome.problems:
        said = f"The network does not carry this: {each.absent.rstrip('.')}. {said}"
    there = _usable(networks, each.network)
    if there is not None and not (outcome.size and outcome.report.link):
        said = f"{said} {there.reach}"
    return said if each.network == networks.stated[0].name else f"On {each.network}: {said}"


def _warn(screen: Screen, outcome: StopOutcome) -> None:
    """Print alarms, claims, and that no robot keeps an emergency stop."""
    report = outcome.report
    for name, why in report.alarms.items():
        screen.say(
            f"ALARM: {name}: {why}. Its own answer {'is missing' if name in report.alarmed else 'came, too'}.",
            "bold red",
        )
    if report.claimed:
        screen.say(CLAIMED, "yellow")
    if report.link and report.silent and not (report.answered or outcome.others.answered):
        screen.say(KEPT_BY_NONE, "yellow")


def _report_one(screen: Screen, networks: Networks, device: str, robot: str, answers: Mapping[str, Envelope]) -> None:
    """Print the stop of one robot on each network; raise unless all stand still.

    Args:
        screen: where.
        networks: of the stop.
        device: the robot's id.
        robot: its name in the report.
        answers: by network.
    """
    if not networks.joined:
        raise CliError(
            plain(f"The network does not carry this: {networks.absences.rstrip('.')}.", 2000),
            Exit.SILENT,
            stopped=None,
            absent=networks.missing,
        )
    said = {each.name: _explained(each, device, answers[each.name]) for each in networks.stated if each.name in answers}
    verdict = combined_verdict({f"{robot} on {name}" if len(said) > 1 else robot: each for name, each in said.items()})
    stopped, texts = verdict["stopped"], verdict["robots"]
    marks = dict.fromkeys(verdict["not_stopped"], False) | dict.fromkeys(verdict["silent"])
    _show_answers(screen, {name: (marks.get(name, True), text) for name, text in texts.items()})
    known = {
        "devices": {robot: {"stopped": stopped, "said": "; ".join(texts.values())}},
        **_facts(verdict),
        "absent": networks.missing,
    }
    say_missing(screen, networks)
    if stopped:
        screen.data({"status": "success", **known})
        return
    groups = {"DID NOT STOP": verdict["not_stopped"], "NO ANSWER": verdict["silent"]}
    failed = [f"{what}: {', '.join(names)}." for what, names in groups.items() if names]
    # One that this machine remembers is no other robot's name that was mistyped.
    alike = near_robots(networks, device) if stopped is None and said == answers else ""
    raise CliError(f"{' '.join(failed)}{alike}", Exit.REFUSED if stopped is False else Exit.SILENT, **known)


def _explained(there: NetworkAdapter, device: str, answer: Envelope) -> Envelope:
    """Return an answer of unknown outcome with what is remembered of the robot."""
    stopped, said = stop_outcome(answer)
    if stopped is not None:
        return answer
    try:
        why = not_reached(there.key, left=True).reasons.get(device, "")
    except RefusalError:
        return answer
    return error(f"{said.rstrip('.')}: {why}", stopped=None) if why and why not in said else answer


def _estop_facts(networks: Networks, each: NetworkVerdict) -> Mapping[str, Any]:
    if each.outcome is None:
        return {}
    there = _usable(networks, each.network)
    return _facts(roster_verdict(each.outcome) if there is None else there.verdict(each.outcome))


def _usable(networks: Networks, name: str) -> NetworkAdapter | None:
    """Return a network on which a stop could leave, None for another one."""
    there = [each for each in networks.stated if each.has_stop_link or each in networks.joined]
    return next((each for each in there if each.name == name), None)


def _plain_facts(networks: Networks, each: NetworkVerdict) -> Mapping[str, Any]:
    del networks
    if each.outcome is None:
        return {}
    graded = {name: stop_outcome(answer) for name, answer in (each.answers or {}).items()}
    missing = {name: (None, each.outcome.reasons.get(name, "no answer")) for name in each.outcome.report.silent}
    devices = {name: {"stopped": stopped, "said": said} for name, (stopped, said) in {**graded, **missing}.items()}
    return {"devices": devices, **_facts(roster_verdict(each.outcome)), **each.outcome.facts()}


def _show_answers(screen: Screen, answers: Mapping[str, tuple[bool | None, str]]) -> None:
    marks = {
        True: label("stopped", "green"),
        False: label("DID NOT STOP", "bold red"),
        None: label("NO ANSWER", "bold red"),
    }
    rows = ((name, marks[stopped], said) for name, (stopped, said) in answers.items())
    screen.show(table("", ("robot", "answer", "what it said"), rows))


def _facts(answer: Envelope) -> dict[str, Any]:
    return {name: value for name, value in answer.items() if name not in ("status", "content", "reason")}
