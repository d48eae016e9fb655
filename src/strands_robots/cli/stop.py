"""``stop``: stop one robot, or all. ``estop``: stop and lock every robot."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.keys import PassphraseFile, operator_key, signing_key
from strands_robots.cli.network import Network, near_robots
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
from strands_robots.envelope import Envelope, text_of
from strands_robots.fleet.callers import SOURCE, TOOL
from strands_robots.fleet.device_connect.stops import devices_on, network_key
from strands_robots.fleet.emergency_stop import EmergencyStop
from strands_robots.fleet.fleet_verdict import NetworkVerdict
from strands_robots.fleet.link_flags import described
from strands_robots.fleet.network_stop import stop_beside
from strands_robots.fleet.stop_answers import combined_verdict, roster_verdict, stop_outcome, unanswered
from strands_robots.safety.controller import DEADLINE_S, Progress
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.serving.stop_arguments import robot_of_world, stop_reason, stop_robot, stop_scope
from strands_robots.utils import ValidationError, device_id, number

if TYPE_CHECKING:
    from strands_robots.fleet.adapter import NetworkAdapter

LINK_WAIT_S = 2.0
"""Longest wait for the connection, after which the deadline counts."""

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
    """Stop one robot, or all. Exits with 1 when one did not stop, with 3 when one is silent."""
    device, unread = stop_robot("DEVICE", None if everything else device)
    everything, device = not device, device or None
    name = robot_of_world({"robot_name": one})[0] if device else ""
    if one and not name:
        unread = unread or "--robot names no robot of a DEVICE's world, so all of it is stopped"
    _say_ignored(screen, unread)
    seconds, on_mesh = _seconds(screen, "--timeout", timeout, 60, 5.0), on_mesh or network.on_mesh_alone
    others = [] if device or on_mesh else _beside(network, lambda each: each.stop_all(seconds)[1])
    with _stopping(screen, network, on_mesh=on_mesh) as there:
        if device is None:
            answers, outcome = there.stop_all(seconds)
            facts = _facts(roster_verdict(outcome)) if on_mesh else {"devices": _devices(answers, outcome)}
        else:
            answer = there.stop(device, seconds, name, insist=True) or unanswered(device)
            stopped, said = stop_outcome(answer)
            alike = ""
            if stopped is None and not on_mesh:
                why = there.silence(device)
                said, alike = (f"{said.rstrip('.')}: {why}", "") if why else (said, near_robots(there, device))
    if device is None:
        _report_all(screen, outcome, facts, there.reach, others)
        return
    # One robot of a world is named with it: the others may move on.
    robot = f"{device}/{name}" if name else device
    _show_answers(screen, {robot: (stopped, said)})
    verdict = combined_verdict({robot: answer})
    facts = _facts(verdict) if on_mesh else {"devices": {robot: {"stopped": stopped, "said": said}}}
    if not stopped:
        what, code = ("DID NOT STOP", Exit.REFUSED) if stopped is False else ("NO ANSWER", Exit.SILENT)
        raise CliError(plain(text_of(verdict), 2000) if on_mesh else f"{what}: {robot}.{alike}", code, **facts)
    screen.data({"status": "success", **facts})
    if on_mesh:
        screen.say(text_of(verdict), "green")


def estop(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[
        list[str] | None,
        typer.Argument(metavar="DEVICE...", help="Those that must answer. Every robot of the tenant stops."),
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
    """Stop every robot of the tenant and lock it. Exits with 1 when one did not stop, with 3 when one is silent.

    With --only or --cell it is for these robots; where none of them is there, every robot is stopped.

    The tenant is the fleet that --tenant names, default without it. The id of the stop is the epoch of the lockout that
    it leaves; a resume names it.
    """
    reason, cut = stop_reason(reason)
    _say_ignored(screen, cut)
    scope, unread = stop_scope(only, cell)
    _say_ignored(screen, unread)
    if on_mesh or network.on_mesh_alone:
        if devices:
            _say_ignored(screen, "estop --mesh stops every robot, and no DEVICE is waited for")
        on_key = None if key is None else signing_key(key, passphrase_file)
        with _stopping(screen, network, on_mesh=True) as there:
            outcome = there.emergency_stop(reason, scope=scope, signing_key=on_key)
        _report_all(screen, outcome, _facts(there.verdict(outcome)), there.reach)
        show_resume(screen, key, f" --mesh{network.flags}")
        return
    # What is no device's id answers to nothing, so the report has it as silent.
    expected = [] if everything else list(devices or [])
    seconds = _seconds(screen, "--deadline", deadline, 600, DEADLINE_S)
    source = device_id("--as", source)
    link = network.link()
    signer = None if key is None else signing_key(key, passphrase_file)
    from strands_robots.device_connect.safety_controller import (  # noqa: PLC0415 - the network is loaded when it is used
        outcome_envelope,
        safety_controller,
    )

    epoch = new_epoch()
    others = _beside(network, lambda each: each.emergency_stop(reason, scope=scope, signing_key=signer, estop_id=epoch))
    controller = safety_controller(source, link, signing_key=signer, require_signed=signer is not None)
    try:
        running = EmergencyStop(
            controller,
            network_key(link),
            reason,
            seconds,
            named=expected,
            devices=None if expected else devices_on(link, seconds),
            scope=scope,
            estop_id=epoch,
            link_wait_s=LINK_WAIT_S,
        )
        if screen.live:
            outcome = _watch(screen, running)
        else:
            outcome = running.outcome()
            screen.show(stop_table(outcome_rows(outcome)))
    finally:
        controller.close()
    report = outcome.report
    say_outcome(screen, outcome)
    for name, why in report.alarms.items():
        screen.say(
            f"ALARM: {name}: {why}. Its own answer {'is missing' if name in report.alarmed else 'came, too'}.",
            "bold red",
        )
    if report.claimed:
        screen.say(CLAIMED, "yellow")
    if report.link and report.silent and not (report.answered or outcome.others.answered):
        screen.say(KEPT_BY_NONE, "yellow")
    _end(screen, outcome, _facts(outcome_envelope(outcome)), "" if report.link else described(link), others)
    if link.loopback_only:
        user = meeting_user(link)
        screen.say(LOCKED)
        screen.copyable(f"  sudo -u {user} {RESUME_HERE}" if user else f"  {RESUME_HERE}")
    else:
        show_resume(screen, key, network.flags)


@contextmanager
def _stopping(screen: Screen, network: Network, *, on_mesh: bool) -> Iterator[NetworkAdapter]:
    """Join the network of a stop; where the mesh is off it ends with code 3."""
    # The table of a stop on the mesh names what the log would report.
    with captured_log() if on_mesh and screen.live else nullcontext():
        try:
            with network.adapter(on_mesh=on_mesh, peer=TOOL) as there:
                yield there
        except CliError as failure:
            if on_mesh and failure.code is Exit.REFUSED:
                raise CliError(failure.reason, Exit.SILENT, stopped=None) from failure
            raise


def _say_ignored(screen: Screen, note: str) -> None:
    """Say what of a stop's arguments is left out; none of them refuses it."""
    if note:
        screen.say(f"Ignored: {plain(note, 300)}.", "yellow")


def _seconds(screen: Screen, name: str, value: float, most: float, usual: float) -> float:
    try:
        return number(name, value, above=0, high=most)
    except ValidationError as unfit:
        _say_ignored(screen, f"{str(unfit).rstrip('.')}; it is {usual:g}")
        return usual


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


def _watch(screen: Screen, running: EmergencyStop) -> StopOutcome:
    """Draw the answers as they come, and return the outcome."""
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    # The table already names what the log would report.
    with captured_log(), Live(stop_table([], "EMERGENCY STOP"), console=screen.out, auto_refresh=False) as live:
        while not wait([running.report], POLL_S).done:
            if running.latest is not None:
                live.update(stop_table(progress_rows(running.latest), _title(running.latest)), refresh=True)
        outcome = running.outcome()
        live.update(stop_table(outcome_rows(outcome), "EMERGENCY STOP"), refresh=True)
    return outcome


def _title(progress: Progress) -> str:
    age = f", pressed {progress.elapsed_ms / 1000:.1f} s ago" if progress.elapsed_ms > LATE_MS else ""
    return f"EMERGENCY STOP{age}" + ("" if progress.link_up else ": THE LINK IS DOWN")


def _beside(network: Network, stop_robots: Callable[[NetworkAdapter], StopOutcome]) -> list[Future[NetworkVerdict]]:
    """Stop the robots of a connection profile's other networks at the same time."""
    return [stop_beside(each, stop_robots) for each in network.beside()]


def _report_all(
    screen: Screen,
    outcome: StopOutcome,
    facts: Mapping[str, Any],
    absent: str = "",
    others: Sequence[Future[NetworkVerdict]] = (),
) -> None:
    """Print a stop of all without times; raise unless the roster stands still."""
    rows = outcome_rows(outcome)
    if rows:
        screen.show(stop_table(rows, timed=False))
        say_outcome(screen, outcome)
    _end(screen, outcome, {**facts, **outcome.facts()}, "" if rows else absent, others)


def _end(
    screen: Screen,
    outcome: StopOutcome,
    facts: Mapping[str, Any],
    where: str,
    others: Sequence[Future[NetworkVerdict]] = (),
) -> None:
    """Print facts for programs; raise unless the rosters of all networks stand still."""
    beside = [each for each in (other.result() for other in others) if each.verdicts() or each.problems]
    known, parts = {**facts}, list[tuple[Exit, str]]()
    if not beside or outcome.size or outcome.problems:
        # Beside a network with robots, one without any is no failure.
        parts.append((exit_code(outcome), f"{failure(outcome)} {where}".rstrip()))
    for each in beside:
        screen.say(f"On {each.network}:")
        if each.outcome is not None:
            screen.show(stop_table(outcome_rows(each.outcome), timed=False))
            say_outcome(screen, each.outcome)
        code = Exit.SILENT if each.outcome is None else exit_code(each.outcome)
        parts.append((code, f"On {each.network}: {each.sentence}"))
        known[each.network] = {name: verdict.stopped for name, verdict in each.verdicts().items()}
    failed = [(code, said) for code, said in parts if code is not Exit.OK]
    if failed:
        worst = Exit.REFUSED if any(code is Exit.REFUSED for code, _ in failed) else Exit.SILENT
        raise CliError(plain(" ".join(said for _, said in failed), 2000), worst, **known)
    screen.data({"status": "success", **known})


def _devices(answers: Mapping[str, Envelope], outcome: StopOutcome) -> dict[str, Any]:
    graded = {name: stop_outcome(answer) for name, answer in answers.items()}
    missing = {name: (None, outcome.reasons.get(name, "no answer")) for name in outcome.report.silent}
    return {name: {"stopped": stopped, "said": said} for name, (stopped, said) in {**graded, **missing}.items()}


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
