"""Stops of all robots, which leave on each network as soon as that is joined."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import CLOSED, STOP_S, NetworkAdapter, StopRequest
from strands_robots.fleet.joining import on_own_thread, side_by_side
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.verdicts import FleetVerdict, NetworkVerdict, not_reached, roster_verdict
from strands_robots.safety.answers import Progress
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.scope import Scope
from strands_robots.safety.sightings import Known, RosterRow
from strands_robots.safety.stop_roster import StopOutcome, robots_known_at
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import plain_text

logger = logging.getLogger(__name__)

KNOWN_S, LOOK_S = 2.5, 0.01
"""Seconds in which a robot that is named becomes known, the discovery of a network included; and between two looks."""

OnNetworkProgress = Callable[[str, Progress], None]
"""Takes the name of a network and the answers on it so far."""


def stop_all(networks: Networks, timeout: float = STOP_S, *, known: Sequence[str] = ()) -> FleetVerdict:
    """Stop every robot in reach, without a lockout; never raises for a verdict.

    Args:
        networks: which need not be opened: what is not joined yet is joined for it.
        timeout: seconds in which a robot has to answer.
        known: further robots that must answer.
    """

    def stopped(network: NetworkAdapter) -> NetworkVerdict:
        answers, outcome = network.stop_all(timeout)
        return NetworkVerdict(network.name, outcome, answers)

    reached, unreached = _parted(networks, _on_each(networks, stopped, apart=False))
    return FleetVerdict(reached, known=known, unreached=unreached)


def estop_all(
    networks: Networks,
    request: StopRequest,
    *,
    known: Sequence[str] = (),
    ignored: Sequence[str] = (),
    on_progress: OnNetworkProgress = lambda network, progress: None,
) -> FleetVerdict:
    """Stop and lock the robots of a request on every network under one id.

    It never raises for a verdict. Where emergency stops have a connection of their own it leaves at once, whether or
    not the network is joined.

    Args:
        networks: which need not be opened: what it needs of them is joined for it.
        request: the stop. Each network waits for its named robots.
        known: further robots that must answer.
        ignored: notes on arguments that could not be read, for the verdict.
        on_progress: called on a thread of the stop; it returns at once.
    """
    scope, named = request.scope, request.named
    over, answered = threading.Event(), set[str]()
    keys: list[Callable[[], NetworkKey]] = [
        *(partial(getattr, each, "key") for each in networks.stated),
        *networks.keys.values(),
    ]

    def remembers(meant: Scope) -> bool:
        # Of the robots that a stop means none need be on each network; only where none is on any all are stopped.
        # A network that is still being joined has its roster, and a disk that hangs hides no other one.
        rosters, until = [on_own_thread(partial(_remembered, each, meant)) for each in keys], time.monotonic() + KNOWN_S
        while time.monotonic() < until:
            if meant.only & answered or any(map(networks.bearers, meant.only)):
                return True
            if any(each.done() and each.result() for each in rosters):
                return True
            if over.wait(LOOK_S):
                break
        return False

    def progressed(network: NetworkAdapter, progress: Progress) -> None:
        answered.update(progress.answered)
        on_progress(network.name, progress)

    def stopped(network: NetworkAdapter) -> NetworkVerdict:
        outcome = network.emergency_stop(
            replace(request, remembers=remembers, on_progress=partial(progressed, network))
        )
        # A link that is down where devices could be looked for is one to which no robot is connected.
        why = "" if outcome.report.link else "; ".join(outcome.problems)
        if why:
            networks.absent[network.name] = why
        return NetworkVerdict(network.name, outcome, absent=why)

    try:
        verdicts = _told_once(_on_each(networks, stopped, apart=True), {*scope.only, *named})
    finally:
        over.set()
    reached, unreached = _parted(networks, verdicts)
    meant = {**dict.fromkeys(known if scope.everything else scope.only), **dict.fromkeys(named)}
    return FleetVerdict(reached, request.estop_id, tuple(meant), ignored, unreached)


def not_left(network: str, key: Callable[[], NetworkKey], why: object) -> NetworkVerdict:
    """Return the verdict of a network that a stop did not reach.

    Args:
        network: its name.
        key: returns the name under which its robots are remembered.
        why: the reason.
    """
    said = plain_text(str(why)) or type(why).__name__
    try:
        return NetworkVerdict(network, not_reached(key()), absent=said)
    except Exception as exc:  # noqa: BLE001 - the roster's disk must not hide the verdicts of other networks
        logger.warning("The roster of %s cannot be read: %s", network, exc)
        return NetworkVerdict(network, absent=said)


def answer_of(verdict: FleetVerdict, networks: Networks) -> Envelope:
    """Return the verdict as one answer.

    That of one network alone is as this network words it.

    With several, ``stopped`` is True, False, or None where it is not known, ``not_stopped`` and ``silent`` list robots,
    ``robots`` has the answers by id and ``networks`` the facts of each network.
    """
    if not verdict.networks:
        return error(f"{networks.absences or CLOSED}.", stopped=None)
    first, *others = verdict.reporting or verdict.networks[:1]
    if not others and first.outcome is not None and not first.absent:
        (adapter,) = (each for each in networks.stated if each.name == first.network)
        return adapter.verdict(first.outcome) if verdict.estop_id else roster_verdict(first.outcome)
    outcomes = [each.outcome for each in verdict.networks if each.outcome is not None]
    moving = [name for name, each in verdict.items() if each.stopped is False]
    still = [name for name, each in verdict.items() if each.stopped]
    scopes = [each.report.scope.field() for each in outcomes]
    fields: dict[str, Any] = {
        "stopped": False if moving else True if verdict.ok else None,
        "not_stopped": moving,
        "silent": [name for name in verdict.missing if name not in moving],
        "robots": {name: _said(each) for name, each in verdict.items()},
        "networks": {each.network: each.facts() for each in verdict.networks},
        **({"estop_id": verdict.estop_id, **scopes[0]} if verdict.estop_id and scopes else {}),
    }
    said = " ".join([*([f"Stopped: {', '.join(still)}."] if still else []), str(verdict)])
    return (success if verdict.ok else error)(said, **fields)


Stopped = tuple[NetworkVerdict, bool]
"""Verdict of a network, and whether the stop left on it, or failed there."""


def _on_each(networks: Networks, stop: Callable[[NetworkAdapter], NetworkVerdict], *, apart: bool) -> list[Stopped]:
    """Stop the robots of each network, side by side, each as soon as it is joined.

    Args:
        networks: all of them.
        stop: stops those of one network.
        apart: one that has a connection of its own for it is not joined.
    """

    def stopped(network: NetworkAdapter) -> Stopped:
        if not (apart and network.has_stop_link) and (why := networks.awaited(network, stops=True)):
            return not_left(network.name, lambda: network.key, why), False
        try:
            verdict = stop(network)
        except Exception as exc:  # noqa: BLE001 - a network that fails must not hide the verdicts of the others
            return not_left(network.name, lambda: network.key, exc), True
        return verdict, verdict.outcome is None or verdict.outcome.report.link

    stops = side_by_side(stopped, networks.stated)
    stops += [
        (not_left(name, key, networks.absent.get(name, "it is not joined")), False)
        for name, key in networks.keys.items()
    ]
    outcomes = for_all([each.outcome for each, _ in stops])
    return [(replace(each, outcome=told), left) for (each, left), told in zip(stops, outcomes, strict=True)]


def _told_once(verdicts: Sequence[Stopped], named: Collection[str]) -> list[Stopped]:
    """Return the verdicts; a named robot is silent where it is known, else once."""
    dropped = [set[str]() for _ in verdicts]
    for name in named:
        silent = [at for at, (each, _) in enumerate(verdicts) if name in each.silent]
        known = [at for at, (each, _) in enumerate(verdicts) if each.has(name)] or silent[:1]
        for at in {*silent} - {*known}:
            dropped[at].add(name)
    return [(each.without(names), left) for (each, left), names in zip(verdicts, dropped, strict=True)]


def for_all(outcomes: Sequence[StopOutcome | None]) -> list[StopOutcome | None]:
    """Return the outcomes of one stop by network; it was for the others' robots, too."""
    known = [frozenset(() if each is None else map(_sure, each.roster.rows)) - {""} for each in outcomes]

    def told(place: int, each: StopOutcome) -> StopOutcome:
        others = frozenset[str]().union(*known[:place], *known[place + 1 :])
        return replace(each, roster=replace(each.roster, elsewhere=max(0, each.roster.elsewhere - len(others))))

    return [None if each is None else told(place, each) for place, each in enumerate(outcomes)]


def _sure(row: RosterRow) -> str:
    """Return the name of a robot that is served here or enrolled, else ""."""
    return row.name if row.processes or row.known is Known.ENROLLED else ""


def _parted(networks: Networks, verdicts: Sequence[Stopped]) -> tuple[list[NetworkVerdict], list[NetworkVerdict]]:
    """Return the verdicts that count, and those of gone networks without robots."""
    # A caller that is new here remembers no robot of a broker that is gone.
    elsewhere = {each.name for each in networks.stated if each.name not in networks.unasked and not each.place.local}
    reached = any(left for _, left in verdicts)
    counted, gone = list[NetworkVerdict](), list[NetworkVerdict]()
    populated = any(each.outcome is not None and each.outcome.size for each, _ in verdicts)
    for each, left in verdicts:
        # Of a network whose roster cannot be read it is not known whether a robot is there.
        counts = not reached or each.network in elsewhere or each.outcome is None or each.outcome.size
        # Beside a network with robots, one of this machine without any need not list them in time.
        counts = counts or (left and not populated)
        (counted if counts else gone).append(each)
    return counted, gone


def _remembered(key: Callable[[], NetworkKey], meant: Scope) -> bool:
    """Return whether this machine remembers a robot that a scope means on a network."""
    try:
        return robots_known_at(key)(meant)
    except UnreachableError:
        # The mesh of a profile that could not be joined has no name.
        return False
    except Exception as exc:  # noqa: BLE001 - the other networks are known all the same
        logger.critical("A roster cannot be read, so none of its robots counts as known: %s", exc)
        return False


def _said(verdict: StopVerdict) -> str:
    return "; ".join([*verdict.not_stopped.values(), *verdict.unknown.values()]) or "stopped"
