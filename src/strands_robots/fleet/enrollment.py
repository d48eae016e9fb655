"""Enrolment of robots: their public keys, and exemptions from answering."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from strands_robots.audit import log_safety_event
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.lockout_report import LockoutReport
from strands_robots.safety.identity import EnrolledKeys, Exemption, fingerprint, local_name
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import CELL_MAX
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose, distrust, own_key
from strands_robots.utils import near, operator, shown

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
