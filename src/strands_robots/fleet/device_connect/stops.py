"""Stops of all robots on Device Connect, measured by the roster."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope
from strands_robots.fleet.adapter import FIND_S, STOP_S
from strands_robots.fleet.emergency_stop import Devices, EmergencyStop
from strands_robots.fleet.stop_answers import measured, roster_verdict, with_plain_stops, with_reasons
from strands_robots.safety.roster_search import FoundDevices
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope
from strands_robots.safety.silence import Sending
from strands_robots.safety.stop_roster import StopOutcome, StopRoster

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.safety.network_key import NetworkKey

ESTOP_S = 1.5
"""Seconds in which robots answer an emergency stop; it is repeated until then."""

SEARCH_SHARE = 2 / 3
"""Part of the deadline in which devices are looked for; the rest is for their answers."""


def stop_everything(fleet: FleetClient) -> Envelope:
    """Stop each device that is found; answers by name, measured by the roster."""
    return roster_verdict(stop_found(fleet, STOP_S)[1])


def stop_found(fleet: FleetClient, seconds: float) -> tuple[dict[str, Envelope], StopOutcome]:
    """Stop each device when it is found; return answers and outcome."""
    roster = StopRoster(network_key(fleet.link))
    answers = fleet.stop_all(seconds)
    # What was found has to answer, though nothing remembers it.
    roster.find(dict.fromkeys(answers, True))
    roster.read()
    sending = Sending(tells=fleet.link.transport == "nats")
    outcome = replace(measured(answers, roster, sending, problem=fleet.stale.rstrip(".")), unsigned=True)
    outcome.record(fleet.source)
    return answers, outcome


def silence_of(fleet: FleetClient, device: str) -> str:
    """Return why a robot of the roster may be silent; "" for another name."""
    roster = StopRoster(network_key(fleet.link))
    roster.read()
    return measured({}, roster, Sending(tells=fleet.link.transport == "nats")).reasons.get(device, "")


def stop_and_lock(fleet: FleetClient, reason: str, scope: Scope = EVERY_ROBOT) -> Envelope:
    """Send an emergency stop under the client's name; answers by name.

    A device of its scope that is in reach and did not answer it gets a plain ``stop`` as well. The roster must answer.
    """
    from strands_robots.device_connect.safety_controller import outcome_envelope  # noqa: PLC0415 - the network is loaded when it is used

    return outcome_envelope(stopped_and_locked(fleet, reason, scope=scope))


def stopped_and_locked(
    fleet: FleetClient,
    reason: str,
    *,
    scope: Scope = EVERY_ROBOT,
    signing_key: Any = None,
    estop_id: str = "",
    remembers: Remembers | None = None,
) -> StopOutcome:
    """Do as :func:`stop_and_lock`; return the outcome.

    Args:
        fleet: a connected client.
        reason: sent to the robots.
        scope: the robots that it is for.
        signing_key: signs it; then only enrolled robots can confirm it.
        estop_id: 32 hex digits; a fresh one by default.
        remembers: says whether a robot of ``scope`` is known; by default by this machine's roster.
    """
    from strands_robots.device_connect.safety_controller import safety_controller  # noqa: PLC0415 - the network is loaded when it is used

    options: dict[str, Any] = {} if signing_key is None else {"signing_key": signing_key, "require_signed": True}
    options |= {} if remembers is None else {"remembers": remembers}
    controller = safety_controller(fleet.source, fleet.link, **options)
    devices = lambda begun: _in_reach(fleet)  # noqa: E731 - the client is connected, so it searches at once
    try:
        stop = EmergencyStop(
            controller,
            network_key(fleet.link),
            reason,
            ESTOP_S,
            devices=devices,
            scope=scope,
            estop_id=estop_id,
        )
        report = stop.report.result()
    finally:
        controller.close()
    rest = stop.unanswered(report)
    # What has not stopped yet waits for no disk.
    answers = fleet.stop_each(rest, STOP_S) if rest else {}
    outcome = stop.measured(report)
    if rest:
        report = with_plain_stops(report, outcome, answers)
        outcome = with_reasons(stop.measured(report), answers, plain=True)
    stop.record(outcome, report)
    return replace(outcome, not_locked=tuple(rest))


def devices_on(link: LinkConfig, deadline_s: float) -> Devices:
    """Return the search for the devices of a network, on a connection of its own.

    Args:
        link: the network.
        deadline_s: of the stop that they must answer; most of it is left for their answers.
    """

    def found(begun: threading.Event) -> FoundDevices:
        from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - the network is loaded when it is used

        with FleetClient(link) as fleet:
            begun.wait()
            return _in_reach(fleet, min(FIND_S, deadline_s * SEARCH_SHARE), thorough=True)

    return found


def network_key(link: LinkConfig) -> NetworkKey:
    """Return the key of the network that a link reaches."""
    from strands_robots.device_connect.enrollment import network_of  # noqa: PLC0415 - the network is loaded when it is used

    return network_of(link)


def _in_reach(fleet: FleetClient, timeout: float = FIND_S, **options: bool) -> FoundDevices:
    peers = fleet.peers(timeout, **options)
    return FoundDevices({peer.id: (peer.stop_verb is not None, peer.cell) for peer in peers}, fleet.stale)
