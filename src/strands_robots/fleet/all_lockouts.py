"""Lockouts on every network: asked for, cleared; and keys of robots enrolled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from strands_robots.errors import NoSuchRobotError, RefusalError
from strands_robots.fleet.adapter import FIND_S, NetworkAdapter
from strands_robots.fleet.enrollment import Enrolled, Enrolment, enroll, shown_key
from strands_robots.fleet.lockout_report import LockoutReport, Resumed
from strands_robots.fleet.networks import Networks
from strands_robots.safety.identity import KeyFileError, fingerprint
from strands_robots.safety.stop_notes import Unheard, unheard_now
from strands_robots.utils import plain_text

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
