"""Stops of all robots, which leave on each network as soon as that is joined."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.fleet.adapter import STOP_S, NetworkAdapter
from strands_robots.fleet.fleet_verdict import FleetVerdict, NetworkVerdict
from strands_robots.fleet.network_stop import not_left
from strands_robots.fleet.networks import CLOSED, Networks
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.fleet.stop_answers import roster_verdict
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster import Roster
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import READ_WITHIN_S, StopOutcome, robots_known_at
from strands_robots.safety.stopping import StopVerdict

logger = logging.getLogger(__name__)


def stop_all(networks: Networks, timeout: float = STOP_S, *, known: Sequence[str] = ()) -> FleetVerdict:
    """Stop every robot in reach, without a lockout; never raises for a verdict.

    Args:
        networks: which need not be joined yet.
        timeout: seconds in which a robot has to answer.
        known: further robots that must answer.
    """

    def stopped(network: NetworkAdapter) -> NetworkVerdict:
        answers, outcome = network.stop_all(timeout)
        return NetworkVerdict(network.name, outcome, answers)

    return FleetVerdict(_on_each(networks, stopped), known=known)


def estop_all(
    networks: Networks,
    reason: str,
    *,
    scope: Scope = EVERY_ROBOT,
    signing_key: Any = None,
    estop_id: str = "",
    known: Sequence[str] = (),
    ignored: Sequence[str] = (),
) -> FleetVerdict:
    """Stop and lock every robot of every network under one id.

    It never raises for a verdict.

    Args:
        networks: which need not be joined yet.
        reason: sent to the robots.
        scope: the robots that it is for. Where none of them is on any network, every robot is stopped.
        signing_key: an Ed25519 private key that signs it.
        estop_id: 32 hex digits, the epoch of the lockout; a fresh one by default.
        known: further robots that must answer.
        ignored: notes on arguments that could not be read, for the verdict.
    """
    epoch = estop_id or new_epoch()

    def remembers(meant: Scope) -> bool:
        # Of the robots that a stop means none need be on each network; only where none is on any all are stopped.
        if any(networks.bearers(name) for name in meant.only):
            return True
        return any(robots_known_at(lambda each=each: each.key)(meant) for each in networks.joined)  # type: ignore[misc]

    def stopped(network: NetworkAdapter) -> NetworkVerdict:
        outcome = network.emergency_stop(
            reason, scope=scope, signing_key=signing_key, estop_id=epoch, remembers=remembers
        )
        strange = {name for name in scope.only if network not in networks.bearers(name)}
        return NetworkVerdict(network.name, outcome, not_here=_not_remembered(network, strange))

    meant = tuple(known) if scope.everything else tuple(scope.only)
    return FleetVerdict(_on_each(networks, stopped), epoch, meant, ignored)


def measured_verdicts(networks: Networks, stop: Callable[[NetworkAdapter], StopOutcome]) -> list[NetworkVerdict]:
    """Return what ``stop`` measures on each network, as verdicts."""
    return _on_each(networks, lambda network: NetworkVerdict(network.name, stop(network)))


def unreached(networks: Networks) -> FleetVerdict:
    """Return the verdict of a stop where no network could be joined.

    It names the robots that this machine remembers there.
    """
    keys = {each.name: partial(_key, each) for each in networks.stated} | networks.keys
    return FleetVerdict([not_left(name, key, networks.absent.get(name, CLOSED)) for name, key in keys.items()])


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


def _on_each(networks: Networks, stop: Callable[[NetworkAdapter], NetworkVerdict]) -> list[NetworkVerdict]:
    """Stop the robots of each network, side by side, each as soon as it is joined."""

    def stopped(network: NetworkAdapter) -> tuple[NetworkVerdict, bool]:
        if why := networks.awaited(network):
            return not_left(network.name, lambda: network.key, why), False
        try:
            return stop(network), True
        except Exception as exc:  # noqa: BLE001 - a network that fails must not hide the verdicts of the others
            return not_left(network.name, lambda: network.key, exc), True

    networks.check_opened()
    stated = networks.stated
    stops = side_by_side(stopped, stated)
    # One of them may have come since the stop left.
    absent = [
        not_left(name, key, networks.absent.get(name, "it is not joined"))
        for name, key in networks.keys.items()
        if all(name != each.name for each in stated)
    ]
    # Of a network whose roster cannot be read it is not known whether a robot is there.
    not_reached = [*(each for each, left in stops if not left), *absent]
    reached = [each for each, left in stops if left]
    return [*reached, *(each for each in not_reached if each.outcome is None or each.outcome.size or not reached)]


def _not_remembered(network: NetworkAdapter, robots: Collection[str]) -> frozenset[str]:
    """Return those robots that this machine does not remember on a network.

    A roster that is not read in time, or cannot be, may have all of them.
    """
    rows: list[frozenset[str]] = []

    def read() -> None:
        try:
            rows.append(frozenset(row.name for row in Roster.of(network.key).rows))
        except Exception as exc:  # noqa: BLE001 - then each of them counts
            logger.warning("The roster of %s cannot be read: %s", network.name, exc)

    if robots:
        reading = threading.Thread(target=read, name="stop roster", daemon=True)
        reading.start()
        reading.join(READ_WITHIN_S)
    return frozenset(robots) - rows[0] if rows else frozenset()


def _key(network: NetworkAdapter) -> NetworkKey:
    return network.key


def _said(verdict: StopVerdict) -> str:
    return "; ".join([*verdict.not_stopped.values(), *verdict.unknown.values()]) or "stopped"
