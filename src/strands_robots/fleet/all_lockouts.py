"""Lockouts on every network: asked for, cleared; and keys of robots enrolled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.adapter import FIND_S, NetworkAdapter
from strands_robots.fleet.enrollment import Enrolled, Enrolment, enroll, shown_key
from strands_robots.fleet.lockout_report import LockoutReport, Resumed
from strands_robots.fleet.networks import Networks
from strands_robots.safety.identity import KeyFileError, fingerprint
from strands_robots.safety.unheard import Unheard, unheard_now

Reports = list[tuple[NetworkAdapter, list[LockoutReport]]]
"""Reports of the lockable robots of each network."""


def ask_lockouts(
    networks: Networks,
    seconds: float,
    *,
    robots: Sequence[str] = (),
    look_s: float = FIND_S,
    signed: bool = False,
) -> Reports:
    """Ask robots for their lockouts, on every network at once.

    A network that does not answer is named in :attr:`Networks.absent`.

    Args:
        networks: joined ones.
        seconds: in which each robot has to answer.
        robots: ids; every robot in reach without any.
        look_s: seconds at most in which robots are looked for.
        signed: ask every robot to sign its answer, so that its key is known.

    Raises:
        UnreachableError: no network answers.
        KeyFileError: the enrolled keys cannot be used.
    """

    def asked(network: NetworkAdapter) -> list[LockoutReport]:
        wanted = [each for each in network.lockable(look_s) if not robots or each in robots]
        return network.lockouts(wanted, seconds, signed=signed)

    return networks.on_each(asked, "robots cannot be asked for their lockouts", fatal=(KeyFileError,))


def by_robot(reports: Reports) -> dict[str, LockoutReport]:
    """Return one report for each robot: that of the first network which has it."""
    return {each.name: each for _, of_network in reversed(reports) for each in of_network}


def unheard_on_each(reports: Reports) -> dict[str, Unheard]:
    """Return by network the robots that a stop locked, and that do not answer."""
    unheard = {
        network.name: unheard_now(network.key, {each.name for each in of_network if not each.problem})
        for network, of_network in reports
    }
    return {name: each for name, each in unheard.items() if each}


def resume_all(
    reports: Reports,
    signing_key: Any,
    seconds: float,
    *,
    robots: Sequence[str] = (),
) -> dict[str, Resumed]:
    """Clear the lockouts of these reports; return by id whether each robot is free.

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
        anew = {each.name: each for each in network.lockouts(twice, seconds)} if twice else {}
        now = [anew.get(each.name, each) for each in wanted]
        for name, outcome in network.resume(now, signing_key, seconds).items():
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
