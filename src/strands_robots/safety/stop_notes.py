"""Sentences on a stop: missing robots, groups, and who was not heard since."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from strands_robots.safety.lockout import Lockout
from strands_robots.safety.network_key import MESH, NetworkKey
from strands_robots.safety.persistence import StoredLockout
from strands_robots.safety.roster import UNTOLD, Roster, cannot_answer, described
from strands_robots.safety.sightings import RosterRow, sightings, this_moment
from strands_robots.safety.stop_roster import NAMED_MAX, StopOutcome
from strands_robots.state_files import uptime

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


@dataclass(frozen=True, slots=True)
class Unheard:
    """Robots that were not heard, and why there may be more."""

    names: tuple[str, ...] = ()
    problem: str = ""

    def __bool__(self) -> bool:
        return bool(self.names or self.problem)

    def __str__(self) -> str:
        more = f" and {len(self.names) - NAMED_MAX} more" if len(self.names) > NAMED_MAX else ""
        said = [f"NOT HEARD: {', '.join(self.names[:NAMED_MAX])}{more}."] if self.names else []
        said += [f"NOT KNOWN who was not heard: {self.problem}."] if self.problem else []
        return f"{' '.join(said)} Robots that are freed keep no stop for one that comes back."


def unheard_now(network: NetworkKey, heard: Collection[str]) -> Unheard:
    """Return the robots of the roster that are not among ``heard``.

    Names that were only heard are left out where robots are enrolled. It reads the disk.
    """
    try:
        roster = Roster.of(network)
    except Exception as exc:  # noqa: BLE001 - said in place of the names
        return Unheard(problem=f"the roster cannot be read: {exc}")
    names = (row.name for row in roster.must_answer if row.name not in heard)
    return Unheard(tuple(names), "; ".join(roster.problems))


def unheard_since(freed: Collection[str], stored: Mapping[str, StoredLockout]) -> Unheard:
    """Return the robots without a sign since the stops that lock ``freed``.

    It asks no network, so that it works without one: a robot of this machine has to have acted on the stop, any other
    one to have been heard since.

    Args:
        freed: names of the robots that are about to be freed.
        stored: this machine's lockout file.
    """
    locked: dict[Lockout, set[str]] = {}
    for each in stored.values():
        for lockout in each.state.lockouts if each.name in freed else ():
            locked.setdefault(lockout, set()).add(each.name)
    acted: dict[str, set[str]] = {}
    for each in stored.values():
        # A robot may have been served as a simulation and as hardware, under one name.
        acted.setdefault(each.name, set()).update(each.seen, each.state.epochs)
    names: dict[str, None] = {}
    try:
        for lockout, robots in locked.items():
            names |= dict.fromkeys(_without(lockout, robots, acted))
    except Exception as exc:  # noqa: BLE001 - said in place of the names
        return Unheard(tuple(names), f"the roster cannot be read: {exc}")
    return Unheard(tuple(names))


def _without(lockout: Lockout, robots: Collection[str], acted: Mapping[str, Collection[str]]) -> Iterable[str]:
    ago = max(0.0, time.time() - lockout.at)
    found, _ = sightings().read(this_moment().earlier(ago))
    for network in {each.network for each in found if each.name in robots}:
        roster = Roster.of(network, uptime() - ago)
        for row in roster.rows:
            must = roster.counts(row) and lockout.scope.covers(row.name, {row.cell} - {""})
            if must and not _had(row, lockout.epoch, ago, acted):
                yield row.name


def _had(row: RosterRow, epoch: str, ago: float, acted: Mapping[str, Collection[str]]) -> bool:
    if epoch in acted.get(row.name, ()):
        return True
    return row.alive is None and row.age_s < ago
