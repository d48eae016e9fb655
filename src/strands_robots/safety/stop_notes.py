"""Sentences on a stop's outcome: missing robots, groups, other networks."""

from __future__ import annotations

from collections.abc import Sequence

from strands_robots.safety.network_key import MESH
from strands_robots.safety.roster import RosterRow
from strands_robots.safety.silence import UNTOLD, cannot_answer, described
from strands_robots.safety.stop_roster import StopOutcome

STOPS_ANYWAY = "Bare devices and robots of earlier releases stop all the same."
FEW = 5
"""Names of a group that are printed."""


def stop_notes(outcome: StopOutcome) -> list[str]:
    """Return sentences on problems, the roster's limit, groups, other networks."""
    scoped = not (outcome.report.scope.everything or outcome.report.widened)
    # On the mesh a stop of named robots is sent to these alone.
    alone = bool(outcome.report.scope.only) and outcome.roster.network.kind == MESH
    notes = [f"This stop was for {outcome.report.scope}.{'' if alone else f' {STOPS_ANYWAY}'}"] if scoped else []
    notes += [problem_sentence(each) for each in outcome.problems]
    notes += [outcome.worth] if outcome.worth else []
    notes += [each for each in (_others(outcome), _unproven(outcome), _no_stop(outcome), _exempt(outcome)) if each]
    notes += [_processes(row) for row in outcome.roster.rows if len(row.processes) > 1][:FEW]
    if outcome.roster.joined:
        where = "; ".join(described(each) for each in outcome.roster.joined[:FEW])
        notes.append(f"Robots known under another address answered, so its robots must answer, too: {where}.")
    if outcome.roster.elsewhere:
        notes.append(f"{_number(outcome.roster.elsewhere, 'robot')} of other networks: this stop is not for them.")
    if outcome.report.silent and not outcome.sending.tells and not _explained(outcome):
        notes.append(UNTOLD)
    return notes


def problem_sentence(problem: str) -> str:
    """Return one of an outcome's problems as a sentence."""
    return f"{problem[:1].upper()}{problem[1:].rstrip('.')}."


def _explained(outcome: StopOutcome) -> bool:
    """Return True where the process of each silent robot cannot answer."""
    rows = {row.name: row for row in outcome.roster.rows}
    return all(name in rows and cannot_answer(rows[name]) for name in outcome.report.silent)


def _others(outcome: StopOutcome) -> str:
    others = outcome.others
    moving = {**others.not_stopped, **others.refused}
    groups = (
        (moving, "did NOT stop", True),
        (others.silent, "gave no answer", True),
        (others.claimed, "claim to have stopped", False),
        (others.stopped, "stopped", False),
    )
    count = sum(len(names) for names, _, _ in groups)
    if not count:
        return ""
    told = [
        f"{len(names)} {said}{f' ({_few(sorted(names))})' if named else ''}" for names, said, named in groups if names
    ]
    many = _number(count, "name")
    return f"{many} only heard, not enrolled: {'; '.join(told)}. This does not alter the exit code."


def _unproven(outcome: StopOutcome) -> str:
    if not outcome.unproven:
        return ""
    names = sorted(outcome.unproven)
    by = _few(sorted(set(outcome.unproven.values())))
    return (
        f"{_number(len(names), 'robot')} reported missing without a signature known here, by {by}: {_few(names)}. "
        "This does not alter the exit code."
    )


def _no_stop(outcome: StopOutcome) -> str:
    return f"Without a stop: {_few(outcome.no_stop)}." if outcome.no_stop else ""


def _exempt(outcome: StopOutcome) -> str:
    rows = outcome.roster.exempt
    names = [f"{row.name} ({row.exemption.state})" if row.exemption else row.name for row in rows]
    return f"Not asked for: {_few(names)}." if names else ""


def _processes(row: RosterRow) -> str:
    return f"{row.name} is served by the processes {_few([str(pid) for _, pid in row.processes])} of this machine."


def _number(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - FEW} more" if len(names) > FEW else ""
    return f"{', '.join(names[:FEW])}{more}"
