"""``stop``: stop one robot, or all. ``estop``: stop and lock every robot."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import wait
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from strands_robots.cli.app import Timeout
from strands_robots.cli.keys import PassphraseFile, operator_key, signing_key
from strands_robots.cli.network import Network, near_robots, say_missing
from strands_robots.cli.output import POLL_S, CliError, Exit, Screen, captured_log, label, plain, table
from strands_robots.cli.readiness import meeting_user
from strands_robots.envelope import Envelope, error
from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import SOURCE, TOOL, NetworkAdapter, StopRequest
from strands_robots.fleet.joining import on_own_thread
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stops import estop_all, stop_all
from strands_robots.fleet.verdicts import (
    FleetVerdict,
    NetworkVerdict,
    combined_verdict,
    not_reached,
    roster_verdict,
    stop_outcome,
)
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.controller import DEADLINE_S
from strands_robots.safety.roster import seconds
from strands_robots.safety.sightings import RosterRow
from strands_robots.safety.stop_notes import problem_sentence, stop_notes
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.serving.stop_arguments import robot_of_world, stop_reason, stop_robot, stop_scope
from strands_robots.utils import ValidationError, device_id, number

SLOW_MS = 100.0
"""An answer that took longer is shown in red."""

LATE_MS = 1000.0
"""A stop that left later than this after the press says so."""


def exit_code(outcome: StopReport | StopOutcome) -> Exit:
    """Return 0 when all stopped, 1 when one did not, 3 when one has not answered.

    A robot that stopped and is not locked gave no answer to the emergency stop.
    """
    report = outcome.report if isinstance(outcome, StopOutcome) else outcome
    free = isinstance(outcome, StopOutcome) and {*outcome.not_locked} & report.stopped.keys()
    if report.not_stopped or report.refused or report.alarmed:
        return Exit.REFUSED
    return Exit.OK if outcome.ok and not free else Exit.SILENT


def style_of(report: StopReport) -> str:
    """Return green when every robot is still, yellow when some only by a claim."""
    if report.ok:
        return "green"
    only_claimed = not (report.not_stopped or report.refused or report.alarmed or report.silent)
    return "yellow" if report.claimed and only_claimed else "bold red"


def summary(report: StopReport) -> str:
    """Return the result in one line of counts."""
    parts = [f"{len(report.stopped)} stopped"]
    for robots, outcome in (
        (report.not_stopped, "DID NOT STOP"),
        (report.refused, "did not act on it"),
        (report.alarmed, "answered with a WRONG KEY"),
        (report.claimed, "claimed"),
        (report.silent, "silent"),
    ):
        parts += [f"{len(robots)} {outcome}"] if robots else []
    late = f" It left {report.left_ms / 1000:.1f} s after the press." if report.left_ms > LATE_MS else ""
    took = f", in {report.elapsed_ms:.0f} ms" if report.elapsed_ms else ""
    which = f" Emergency stop {report.estop_id}." if report.estop_id else ""
    return f"{', '.join(parts)}{took}.{late}{which}"


def failure(outcome: StopOutcome) -> str:
    """Return one line: the robots not known to stand still, and problems."""
    report = outcome.report
    groups = (
        (report.not_stopped, "DID NOT STOP"),
        (report.refused, "DID NOT ACT ON IT"),
        (report.alarmed, "WRONG KEY"),
        (report.claimed, "CLAIMED, NOT SIGNED"),
        (report.silent, "NO ANSWER"),
        ({*outcome.not_locked} & report.stopped.keys(), "STOPPED, NOT LOCKED"),
    )
    said = [f"{what}: {', '.join(sorted(robots))}." for robots, what in groups if robots]
    if not report.link:
        said.append("The stop was not sent: the link is down.")
    return " ".join([*said, *map(problem_sentence, outcome.problems)]) or "No robot that can be stopped answered."


def report_rows(report: StopReport, reasons: Mapping[str, str] | None = None) -> list[tuple[Any, ...]]:
    """Return one row for each robot of a finished stop, the worst first."""
    left_ms, why = report.left_ms, reasons or {}
    worst = [_row(name, each, left_ms) for name, each in sorted({**report.not_stopped, **report.refused}.items())]
    worst += [_silent_row(name, "WRONG KEY", report.alarms[name]) for name in report.alarmed]
    worst += [_silent_row(name, "NO ANSWER", why.get(name, "")) for name in report.silent]
    worst += [_row(name, each, left_ms) for name, each in sorted(report.claimed.items())]
    slowest = sorted(report.stopped.items(), key=lambda each: -each[1].latency_ms)
    return [*worst, *(_row(*each, left_ms) for each in slowest)]


def outcome_rows(outcome: StopOutcome) -> list[tuple[Any, ...]]:
    """Return the rows: robots, devices without a stop, and exempt robots."""
    rows = report_rows(outcome.report, outcome.reasons)
    rows += [(name, label("has no stop", "yellow"), "", "it cannot be stopped from here") for name in outcome.no_stop]
    rows += [(row.name, label(_state(row), "yellow"), "", _marked(row)) for row in outcome.roster.exempt]
    return rows


def progress_rows(progress: Progress) -> list[tuple[Any, ...]]:
    """Return one row for each robot of a stop in progress."""
    answered = [_row(*each, progress.left_ms) for each in sorted(progress.answered.items())]
    marks = {name: "WRONG KEY" if name in progress.alarms else "unconfirmed" for name in progress.unconfirmed}
    return [*(_silent_row(name, mark) for name, mark in marks.items() if name not in progress.answered), *answered]


def stop_table(rows: Mapping[str, Sequence[tuple[Any, ...]]], title: str = "", *, timed: bool = True) -> Table:
    """Return the table of a stop; the network is named where several have rows.

    Args:
        rows: by network.
        title: of the table.
        timed: with the times of answers.
    """
    several = sum(map(bool, rows.values())) > 1
    every = [(row[0], network, *row[1:]) for network, each in rows.items() for row in each]
    # The mesh times no answer.
    timed = timed and (not every or any(str(row[3]) for row in every))
    columns = ("robot", "network", "answer", "ms", "what it said")
    kept = [at for at, column in enumerate(columns) if (timed or column != "ms") and (several or column != "network")]
    return table(title, [columns[at] for at in kept], [[row[at] for at in kept] for row in every])


def say_outcome(screen: Screen, outcome: StopOutcome) -> None:
    """Print counts, the roster's size, groups, and other networks."""
    screen.say(summary(outcome.report), "bold red" if outcome.problems else style_of(outcome.report))
    screen.say(outcome.sentence, "green" if outcome.ok else "bold red")
    # The command ends with its problems.
    problems = {plain(problem_sentence(each), 600) for each in outcome.problems}
    for line in outcome_lines(outcome):
        if line not in problems:
            screen.say(line, "yellow")


def outcome_lines(outcome: StopOutcome) -> list[str]:
    """Return the notes of an outcome, printable."""
    return [plain(each, 600) for each in stop_notes(outcome)]


def _state(row: RosterRow) -> str:
    return row.exemption.state if row.exemption is not None else "off"


def _marked(row: RosterRow) -> str:
    mark = row.exemption
    said = f"by {mark.by}: {mark.reason or 'no reason'}" if mark is not None else ""
    heard = f"; heard under its name {seconds(max(0.0, row.age_s))} ago" if row.age_s is not None else ""
    return plain(f"{said}{heard}", 300)


def _row(name: str, answer: Answer, left_ms: float) -> tuple[Any, ...]:
    # Connecting takes this command some tenths of a second; the table shows the robots' time, the summary the rest.
    took_ms = answer.latency_ms - (left_ms if left_ms <= LATE_MS else 0.0)
    slow = "bold red" if took_ms > SLOW_MS else ""
    still = "stopped, settling" if answer.facts.get("settling") is True else "stopped"
    mark = label(still, slow or "green") if answer.stopped else label("DID NOT STOP", "bold red")
    if answer.stopped is None:
        mark = label("UNKNOWN", "bold red")
    said = answer.why or _halted(answer.facts)
    if answer.claimed and answer.stopped:
        mark, said = label("claimed", "yellow"), f"not signed by {name}; {said}"
    if answer.delay_s is not None and answer.delay_s * 1000 > LATE_MS:
        said = f"{said}; it arrived {answer.delay_s:.1f} s after the press"
    # The mesh times no answer.
    return name, mark, label(f"{took_ms:.1f}" if answer.latency_ms else "", slow), said


def _silent_row(name: str, mark: str, why: str = "") -> tuple[Any, ...]:
    return name, label(mark, "bold red"), "", why


def _halted(facts: Mapping[str, Any]) -> str:
    halted = facts.get("halted")
    names = ", ".join(str(each) for each in halted) if isinstance(halted, list | tuple) else ""
    return f"halted {names}" if names else "locked; nothing was moving"


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


def stop(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str | None, typer.Argument(help="The device's id.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Stop every device that answers.")] = False,
    one: Annotated[str, typer.Option("--robot", help="Stop this robot of DEVICE's world alone.")] = "",
    timeout: Timeout = 5.0,
) -> None:
    """Stop one robot, or all, on every network.

    Exits with 1 when one did not stop, with 3 when one is silent.
    """
    device, unread = stop_robot("DEVICE", None if everything else device)
    name = robot_of_world({"robot_name": one})[0] if device else ""
    if one and not name:
        unread = unread or "--robot names no robot of a DEVICE's world, so all of it is stopped"
    seconds, unfit = _seconds("--timeout", timeout, 60, 5.0)
    with _stopping(screen, network) as networks:
        if device:
            answers = networks.stop(device, seconds, name)
            _say_ignored(screen, unread, unfit)
            # One robot of a world is named with it: the others may move on.
            _report_one(screen, networks, device, f"{device}/{name}" if name else device, answers)
        else:
            verdict = stop_all(networks, seconds)
            _say_ignored(screen, unread, unfit)
            _report(screen, networks, verdict)


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
    with _stopping(screen, network, source) as networks:
        latest: dict[str, Progress] = {}
        request = StopRequest(
            reason,
            scope,
            signing_key=None if key is None else signing_key(key, passphrase_file),
            # What is no device's id answers to nothing, so the report has it as silent.
            named=() if everything else tuple(devices or ()),
            deadline_s=seconds,
        )
        pressed = partial(estop_all, networks, request, on_progress=latest.__setitem__)
        verdict = _watched(screen, networks, pressed, latest) if screen.live else pressed()
        _say_ignored(screen, cut, unread, unfit)
        try:
            _report(screen, networks, verdict, drawn=screen.live)
        finally:
            # A robot that did not stop is locked all the same.
            locked = {each.network for each in verdict.networks if _locked(each)}
            there = [each for each in networks.stated if each.name in locked]
            if there and all(each.place.local for each in there):
                user = meeting_user(there[0].place.meeting_port)
                screen.say(LOCKED)
                screen.copyable(f"  sudo -u {user} {RESUME_HERE}" if user else f"  {RESUME_HERE}")
            elif there:
                show_resume(screen, key, network.flags)


@contextmanager
def _stopping(screen: Screen, network: Network, source: str | None = None) -> Iterator[Networks]:
    """Make the networks of a stop, which joins them itself."""
    try:
        networks = network.networks(source=TOOL if network.mesh else source)
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
    verdict = on_own_thread(pressed)
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


def _report(screen: Screen, networks: Networks, verdict: FleetVerdict, *, drawn: bool = False) -> None:
    """Print a stop of all; raise unless every robot that must answer stands still.

    Args:
        screen: where.
        networks: of the stop.
        verdict: of the stop.
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
    # Programs read these of the first network; robots of others stand under the network's name.
    known = (_estop_facts if estop else _plain_facts)(networks, first)
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
        said = f"{said} {there.place.text}"
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
    marks = dict.fromkeys(verdict["not_stopped"], label("DID NOT STOP", "bold red"))
    marks |= dict.fromkeys(verdict["silent"], label("NO ANSWER", "bold red"))
    rows = ((name, marks.get(name) or label("stopped", "green"), text) for name, text in texts.items())
    screen.show(table("", ("robot", "answer", "what it said"), rows))
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


def _estop_facts(networks: Networks, each: NetworkVerdict) -> dict[str, Any]:
    if each.outcome is None:
        return {}
    there = _usable(networks, each.network)
    return _facts(roster_verdict(each.outcome) if there is None else there.verdict(each.outcome))


def _usable(networks: Networks, name: str) -> NetworkAdapter | None:
    """Return a network on which a stop could leave, None for another one."""
    there = [each for each in networks.stated if each.has_stop_link or each in networks.joined]
    return next((each for each in there if each.name == name), None)


def _plain_facts(networks: Networks, each: NetworkVerdict) -> dict[str, Any]:
    del networks
    if each.outcome is None:
        return {}
    graded = {name: stop_outcome(answer) for name, answer in (each.answers or {}).items()}
    missing = {name: (None, each.outcome.reasons.get(name, "no answer")) for name in each.outcome.report.silent}
    devices = {name: {"stopped": stopped, "said": said} for name, (stopped, said) in {**graded, **missing}.items()}
    return {"devices": devices, **_facts(roster_verdict(each.outcome)), **each.outcome.facts()}


def _facts(answer: Envelope) -> dict[str, Any]:
    return {name: value for name, value in answer.items() if name not in ("status", "content", "reason")}
