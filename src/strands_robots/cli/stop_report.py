"""Report of an emergency stop as a terminal shows it: rows, counts, sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from strands_robots.cli.output import Exit, Screen, label, plain, table
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.roster import RosterRow, seconds
from strands_robots.safety.stop_notes import problem_sentence, stop_notes
from strands_robots.safety.stop_roster import StopOutcome

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
