"""Lockouts and keys on every network: asked for, cleared, enrolled, exempted."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from strands_robots.audit import log_safety_event
from strands_robots.errors import NoSuchRobotError, RefusalError
from strands_robots.fleet.adapter import FIND_S, LockoutReport, NetworkAdapter, Resumed
from strands_robots.fleet.networks import Networks
from strands_robots.safety.identity import EnrolledKeys, Exemption, KeyFileError, fingerprint, local_name
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import CELL_MAX
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose, distrust, own_key
from strands_robots.safety.stop_notes import Unheard, unheard_now
from strands_robots.utils import near, operator, plain_text, shown

FORGET = "forget"
"""Change that undoes an enrolment."""


class Enrolled(Enum):
    """Outcome of the enrolment of one robot."""

    NEW = "enrolled"
    KNOWN = "known"
    NO_KEY = "no key"
    CHANGED_KEY = "CHANGED KEY"
    TWO_KEYS = "TWO KEYS"


@dataclass(frozen=True, slots=True)
class Enrolment:
    """One robot after an attempt to enroll it.

    Attributes:
        outcome: what came of it.
        fingerprint: of the key that the robot shows; empty without one.
        said: why it is not enrolled; empty where it is.
    """

    outcome: Enrolled
    fingerprint: str = ""
    said: str = ""


def enroll(reports: Sequence[LockoutReport], network: NetworkKey, *, replace: bool = False) -> dict[str, Enrolment]:
    """Keep the keys that robots signed with; return each robot's outcome.

    A robot that was exempt and shows its key must answer again.

    Args:
        reports: signed answers of the robots, as :meth:`NetworkAdapter.lockouts` gives them.
        network: where they were asked.
        replace: accept another key than the enrolled one, or another network.

    Raises:
        KeyFileError, OSError: the file of enrolled keys cannot be used; nothing was enrolled.
    """
    file, tenant = EnrolledKeys(), network.tenant
    known, fresh = file.load(), dict[str, bytes]()
    outcomes, cells = dict[str, Enrolment](), dict[str, str]()
    for each in reports:
        local, public = local_name(tenant, each.name), shown_key(each)
        cell = _signed_cell(each, public)
        cells |= {} if cell is None else {local: cell}
        mark = "" if public is None else fingerprint(public)
        if public is None:
            why = each.problem or "it shows no key; it runs another version, or its log says why"
            outcomes[each.name] = Enrolment(Enrolled.NO_KEY, said=why)
        elif known.get(local, public) != public and not replace:
            why = f"enrolled is {fingerprint(known[local])}; nothing was changed"
            outcomes[each.name] = Enrolment(Enrolled.CHANGED_KEY, mark, why)
        else:
            outcomes[each.name] = Enrolment(Enrolled.KNOWN if known.get(local) == public else Enrolled.NEW, mark)
            fresh[local] = public
    for local, exempt in file.enroll(fresh, replace=replace, network=network, cells=cells).items():
        log_safety_event("exemption_undone", local, {"was": exempt.state, "by": exempt.by, "who": operator()})
    return outcomes


def shown_key(report: LockoutReport) -> bytes | None:
    """Return the key that a robot signed its report with; None without one."""
    return own_key(Purpose.LOCKOUT_STATE, report.name, _statement(report.facts))


def change_enrolment(robot: str, action: str, reason: str = "", *, tenant: str = "") -> str:
    """Exempt an enrolled robot, or undo its enrolment; return its name.

    The change is recorded in the audit under the operator's name.

    Args:
        robot: its name.
        action: ``retired``, ``off`` or :data:`FORGET`.
        reason: printed at every stop.
        tenant: in which its name is looked up first.

    Raises:
        NoSuchRobotError: it is not enrolled.
        KeyFileError, OSError: the file cannot be used; nothing was changed.
    """
    file, who = EnrolledKeys(), operator()
    known = file.robots()
    own = local_name(tenant, robot)
    name = own if own in known else robot
    if name not in known:
        there = f"Enrolled: {', '.join(sorted(known))}." if known else "No robot is enrolled."
        raise NoSuchRobotError(f"{shown(robot)} is not enrolled", remedy=f"{there}{near(robot, known)}")
    if action == FORGET:
        file.forget(name)
    else:
        file.exempt(name, Exemption(action, who, reason, time.time()))
    facts = {"who": who, "reason": reason, "fingerprint": fingerprint(known[name].key)}
    log_safety_event(f"enrolment_{'forgotten' if action == FORGET else action}", name, facts)
    return name


def served_here(robot: str) -> bool:
    """Return whether a living process of this machine serves this robot."""
    return any(each.alive and local_name(each.network.tenant, each.name) == robot for each in sightings().read()[0])


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


FAILED = "robots cannot be asked for their lockouts"

Reports = list[tuple[NetworkAdapter, list[LockoutReport]]]
"""Reports of the lockable robots of each network."""


def ask_lockouts(
    networks: Networks,
    seconds: float,
    *,
    robots: Sequence[str] = (),
    besides: Sequence[str] = (),
    look_s: float = FIND_S,
    signed: bool = False,
) -> Reports:
    """Ask robots for their lockouts, on every network at once.

    A network that does not answer is named in :attr:`Networks.absent`.

    Args:
        networks: joined ones.
        seconds: in which each robot has to answer.
        robots: ids; every robot in reach without any.
        besides: ids that are asked, too. These and ``robots`` are asked though they are not found.
        look_s: seconds at most in which robots are looked for.
        signed: ask every robot to sign its answer, so that its key is known.

    Raises:
        UnreachableError: no network answers.
        KeyFileError: the enrolled keys cannot be used.
    """

    def asked(network: NetworkAdapter) -> list[LockoutReport]:
        wanted = [each for each in network.lockable(look_s) if not robots or each in robots]
        return network.lockouts(wanted, seconds, signed=signed)

    def insisted(network: NetworkAdapter) -> list[LockoutReport]:
        return network.lockouts([each for each in missing if network.reaches(each)], seconds, signed=signed)

    reports = networks.on_each(asked, FAILED, fatal=(KeyFileError,))
    found = by_robot(reports)
    missing = [each for each in dict.fromkeys([*robots, *besides]) if each not in found]
    if missing:
        late = dict(networks.on_each(insisted, FAILED, fatal=(KeyFileError,)))
        reports = [(network, [*of_network, *late.get(network, ())]) for network, of_network in reports]
    return reports


def by_robot(reports: Reports) -> dict[str, LockoutReport]:
    """Return one report for each robot, with its lockouts on all networks."""
    several: dict[str, dict[str, LockoutReport]] = {}
    for network, of_network in reports:
        for each in of_network:
            several.setdefault(each.name, {})[network.name] = each
    return {name: _joined(of_robot) for name, of_robot in several.items()}


def _joined(reports: Mapping[str, LockoutReport]) -> LockoutReport:
    """Return the reports of a robot as one; locked on one network is locked."""
    first = next(iter(reports.values()))
    if len(reports) == 1:
        return first
    lockouts = {lockout.epoch: lockout for each in reports.values() for lockout in each.lockouts}
    problems = [f"{network}: {each.problem}" for network, each in reports.items() if each.problem]
    return replace(first, lockouts=tuple(lockouts.values()), problem="; ".join(problems))


def unheard_in(reports: Reports) -> Unheard:
    """Return the robots of the rosters of these networks that do not answer."""
    each = [
        unheard_now(network.key, {report.name for report in of_network if not report.problem})
        for network, of_network in reports
    ]
    names = dict.fromkeys(name for unheard in each for name in unheard.names)
    return Unheard(tuple(names), "; ".join(unheard.problem for unheard in each if unheard.problem))


def resume_all(
    reports: Reports,
    signing_key: Any,
    seconds: float,
    *,
    robots: Sequence[str] = (),
) -> dict[str, Resumed]:
    """Clear the lockouts of these reports; return by id whether each robot is free.

    No robot of a network that fails counts as free; what each says names the network and the reason.

    Args:
        reports: as :func:`ask_lockouts` gives them.
        signing_key: the operator's Ed25519 private key.
        seconds: in which each robot has to answer.
        robots: ids; every one of the reports without any.

    Raises:
        NoSuchRobotError: one of ``robots`` is not in the reports.
    """
    for name in robots:
        if not any(name == report.name for _, of_network in reports for report in of_network):
            raise NoSuchRobotError(f"No robot {name!r} that can be resumed is in reach")
    outcomes: dict[str, Resumed] = {}
    for network, of_network in reports:
        wanted = [each for each in of_network if not robots or each.name in robots]
        # A robot that is served on both was freed by the first: it refuses a second resume.
        twice = [each.name for each in wanted if each.name in outcomes]
        try:
            anew = {each.name: each for each in network.lockouts(twice, seconds)} if twice else {}
            resumed = network.resume([anew.get(each.name, each) for each in wanted], signing_key, seconds)
        except Exception as exc:  # noqa: BLE001 - what was freed on the other network is told all the same
            why = exc.why if isinstance(exc, RefusalError) else plain_text(f"{type(exc).__name__}: {exc}")
            resumed = dict.fromkeys((each.name for each in wanted), (False, f"{network.name} failed: {why}"))
        for name, outcome in resumed.items():
            # Locked on one of two networks is locked.
            outcomes[name] = min(outcomes.get(name, outcome), outcome, key=lambda each: each[0])
    return outcomes


def enroll_all(reports: Reports, *, replace: bool = False) -> dict[str, Enrolment]:
    """Keep the public keys of robots that signed their reports.

    A robot that shows two keys is not enrolled.

    Args:
        reports: signed ones, as :func:`ask_lockouts` gives them.
        replace: accept another key than the enrolled one, or another network.

    Raises:
        KeyFileError, OSError: the file of enrolled keys cannot be used; nothing was enrolled.
    """
    keys: dict[str, dict[bytes, str]] = {}
    for network, of_network in reports:
        for each in of_network:
            if (key := shown_key(each)) is not None:
                keys.setdefault(each.name, {}).setdefault(key, network.name)
    several = {name: shown for name, shown in keys.items() if len(shown) > 1}
    outcomes = {name: Enrolment(Enrolled.TWO_KEYS, said=_two_keys(shown)) for name, shown in several.items()}
    for network, of_network in reports:
        alone = [each for each in of_network if each.name not in several]
        for name, outcome in enroll(alone, network.key, replace=replace).items():
            # A key that one network shows is the robot's, though the other shows none.
            if name not in outcomes or outcomes[name].outcome is Enrolled.NO_KEY:
                outcomes[name] = outcome
    return outcomes


def _two_keys(keys: Mapping[bytes, str]) -> str:
    shown_keys = ", ".join(f"{network} shows {fingerprint(key)}" for key, network in keys.items())
    return f"{shown_keys}; neither was enrolled"
