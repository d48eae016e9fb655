"""Stops of all robots on Device Connect, measured by the roster."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope
from strands_robots.fleet.adapter import FIND_S, STOP_S, StopRequest
from strands_robots.fleet.verdicts import measured, with_plain_stops, with_reasons
from strands_robots.safety.answers import Progress, StopReport
from strands_robots.safety.roster import Sending
from strands_robots.safety.scope import EVERY_ROBOT
from strands_robots.safety.stop_roster import FoundDevices, RosterSearch, StopOutcome, StopRoster

logger = logging.getLogger(__name__)

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.safety.network_key import NetworkKey

ESTOP_S = 1.5
"""Seconds in which robots answer an emergency stop; it is repeated until then."""

LINK_WAIT_S = 2.0
"""Longest wait for the connection of an emergency stop, after which its deadline counts."""

SEARCH_SHARE = 2 / 3
"""Part of a deadline in which devices are looked for; the rest is for their answers."""

PLAIN_STOPS_MAX = 512
"""Devices that get a plain stop after an emergency stop on which they did not act."""

Connect = Callable[[], AbstractContextManager["FleetClient"]]
"""Connects a client for the length of a block, or lends one that is connected."""


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


def stopped_and_locked(
    link: LinkConfig,
    source: str,
    connect: Connect,
    request: StopRequest,
) -> StopOutcome:
    """Send an emergency stop at once, on a connection of its own; return the outcome.

    Devices are looked for meanwhile. One of the scope that is in reach and did not act on it gets a plain ``stop`` as
    well. The roster must answer.

    Args:
        link: the network.
        source: the name under which it is sent.
        connect: gives the client that looks for devices, and stops those.
        request: the stop. Its deadline counts from when the link is up, and a plain stop then has as long.
    """
    from strands_robots.device_connect.safety_controller import safety_controller  # noqa: PLC0415 - the network is loaded when it is used

    key, named, deadline_s, estop_id = request.signing_key, request.named, request.deadline_s, request.estop_id
    options: dict[str, Any] = {} if key is None else {"signing_key": key, "require_signed": True}
    options |= {} if request.remembers is None else {"remembers": request.remembers}
    controller = safety_controller(source, link, **options)
    seconds = ESTOP_S if deadline_s is None else deadline_s
    look_s = FIND_S if deadline_s is None else min(FIND_S, deadline_s * SEARCH_SHARE)
    lookup = None if named else _Lookup(connect, look_s)
    try:
        controller.press(estop_id)
        look_up = None if lookup is None else lookup.found.result
        search = RosterSearch(controller, estop_id, network_key(link), look_up, request.scope, named=named)
        if lookup is not None:
            lookup.start(search)

        def progressed(progress: Progress) -> None:
            search.begin(progress)
            if lookup is not None:
                lookup.stop_has_left()
            request.on_progress(progress)

        # Nothing can leave before the link is up; then the milliseconds are the robots' and not the handshake's.
        controller.wait_link(LINK_WAIT_S)
        report = controller.stop(
            named,
            request.reason,
            deadline_s=seconds,
            estop_id=estop_id,
            more=True,
            on_progress=progressed,
            on_report=search.take,
            scope=request.scope,
        )
        sending = replace(controller.sending, left=report.link)
    finally:
        if lookup is not None:
            lookup.end()
        controller.close()
    search.start()
    rest = [] if lookup is None else _unanswered(search, lookup, report, deadline_s)
    answers: dict[str, Envelope] = {}
    if rest:
        # What has not stopped yet waits for no disk.
        try:
            with connect() as fleet:
                answers = fleet.stop_each(rest, STOP_S if deadline_s is None else min(STOP_S, deadline_s))
        except Exception as exc:  # noqa: BLE001 - the answers to the emergency stop count all the same
            logger.warning("A plain stop of %d devices failed: %s", len(rest), exc)
    outcome = _measured(search, report, sending)
    if rest:
        missed = {name: why for name, why in outcome.reasons.items() if name in rest}
        report = with_plain_stops(report, outcome, answers)
        outcome = with_reasons(_measured(search, report, sending), answers, plain=True)
        outcome = replace(outcome, not_locked=tuple(rest), reasons={**missed, **outcome.reasons})
    outcome.record(controller.controller_id)
    search.roster.remember(report)
    return outcome


class _Lookup:
    """Search for the devices in reach, which begins once an emergency stop has left.

    One that fails is tried once more: a network may not be there yet.
    """

    def __init__(self, connect: Connect, seconds: float) -> None:
        self.found: Future[FoundDevices] = Future()
        self._connect, self._seconds = connect, seconds
        self._begins, self._over = threading.Event(), threading.Event()
        self._left = False

    def start(self, search: RosterSearch) -> None:
        """Connect now, and search once the stop has left."""
        self._search = search
        threading.Thread(target=self._run, name="estop lookup", daemon=True).start()

    def stop_has_left(self) -> None:
        """Begin the search; a second call does nothing."""
        if not self._left:
            self._left = True
            threading.Thread(target=self._begin, name="estop lookup", daemon=True).start()

    def end(self) -> None:
        """Leave no search waiting, and try none again."""
        self._over.set()
        self._begins.set()

    def _begin(self) -> None:
        # What a search hears is written into the memory that the roster is read from, so that is read before.
        self._search.roster.wait_until_read()
        self._begins.set()

    def _run(self) -> None:
        for last in (False, True):
            try:
                self.found.set_result(self._devices())
            except BaseException as exc:  # noqa: BLE001 - raised again by the future; a binding's panic is no Exception
                self._search.failed(exc)
                # A network that is not there yet is asked again once the stop has begun.
                self._begins.wait()
                if last or self._over.is_set():
                    self.found.set_exception(exc)
                    return
            else:
                return

    def _devices(self) -> FoundDevices:
        with self._connect() as fleet:
            self._begins.wait()
            peers = fleet.peers(self._seconds, thorough=True)
            return FoundDevices({peer.id: (peer.stop_verb is not None, peer.cell) for peer in peers}, fleet.stale)


def _unanswered(search: RosterSearch, lookup: _Lookup, report: StopReport, within: float | None) -> list[str]:
    """Return the devices in reach that can be stopped, and did not act on a stop.

    It waits for the search as long as ``within``, and not where the stop did not leave.
    """
    try:
        found = lookup.found.result(within if report.link else 0)
    except KeyboardInterrupt:
        raise
    except BaseException:  # noqa: BLE001 - logged by the search, and told by the outcome
        return []
    search.complete(found)
    answered = {*report.stopped, *report.not_stopped, *report.refused}
    scope = EVERY_ROBOT if report.widened else search.scope
    rest = [
        name
        for name, (stops, cell) in found.devices.items()
        if stops and name not in answered and scope.covers(name, {cell or ""} - {""})
    ]
    # Names can be made up: those of the roster come first.
    counted = search.roster.awaited(report.answered)
    return sorted(rest, key=lambda name: name not in counted)[:PLAIN_STOPS_MAX]


def _measured(search: RosterSearch, report: StopReport, sending: Sending) -> StopOutcome:
    """Return the report of a stop, measured by its roster."""
    why = search.problem
    problem = f"The robots that must answer could not be looked up: {why}." if why else ""
    return search.roster.outcome(report, sending, problem)


def network_key(link: LinkConfig) -> NetworkKey:
    """Return the key of the network that a link reaches."""
    from strands_robots.device_connect.backends.config import network_of  # noqa: PLC0415 - the network is loaded when it is used

    return network_of(link)
