"""Stops of all robots on Device Connect; their lockouts and resumes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope, text_of
from strands_robots.fleet.adapter import FIND_S, STOP_S, TOO_MANY, LockoutReport, Resumed, StopRequest
from strands_robots.fleet.device_connect.config import enrolled_keys
from strands_robots.fleet.shared_id import Keys
from strands_robots.fleet.verdicts import measured, with_plain_stops, with_reasons
from strands_robots.safety.answers import Progress, StopReport
from strands_robots.safety.identity import KeyFileError
from strands_robots.safety.lockout import OVERFLOW, Lockout
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.resume import sign
from strands_robots.safety.roster import Sending
from strands_robots.safety.scope import EVERY_ROBOT
from strands_robots.safety.statements import Purpose, distrust
from strands_robots.safety.stop_roster import FoundDevices, RosterSearch, StopOutcome, StopRoster
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.safety.network_key import NetworkKey

logger = logging.getLogger(__name__)

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


KEYS_UNUSABLE = "the enrolled keys cannot be used"


def ask_robots(
    fleet: FleetClient, names: Iterable[str], seconds: float, *, signed: bool = False
) -> list[LockoutReport]:
    """Ask each robot for its status, many at once and without a thread for each.

    An enrolled robot whose answer is not its own has a ``problem``.

    Args:
        signed: ask every robot to sign its answer, even one that announces no nonce.
    """
    keys = enrolled_keys(fleet.link)
    asked = {name: status_question(fleet, name, signed=signed or name in keys) for name in names}
    reports = []
    for name, (answer, took_s) in fleet.call_each(asked, "getStatus", seconds).items():
        if isinstance(answer, Exception):
            reports.append(LockoutReport(name, problem=plain_text(str(answer), 2000)))
        else:
            reports.append(status_report(name, answer, took_s * 1000, keys.get(name), asked[name]))
    return reports


async def ask_robot(fleet: FleetClient, name: str, seconds: float, keys: Keys) -> LockoutReport:
    """Ask one robot for its status, on the event loop of the caller.

    Args:
        keys: enrolled ones; without any no answer counts.
    """
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

    key = None if keys is None else keys.get(name)
    asked, began = status_question(fleet, name, signed=key is not None), time.monotonic()
    try:
        answer = await fleet.call_async(name, "getStatus", asked, seconds)
    except (LookupError, TimeoutError, RuntimeError, ValueError, MessagingError) as exc:
        return LockoutReport(name, problem=plain_text(str(exc), 2000))
    took_ms = (time.monotonic() - began) * 1000
    if keys is None:
        return LockoutReport(name, problem=KEYS_UNUSABLE, facts=answer, round_trip_ms=took_ms)
    return status_report(name, answer, took_ms, key, asked)


def status_question(fleet: FleetClient, name: str, *, signed: bool) -> dict[str, str]:
    """Return the arguments of ``getStatus``: a fresh nonce, by which the robot signs.

    Args:
        signed: ask for the signature in any case; without it only a robot that announces the nonce is asked for it.
    """
    return {"nonce": new_epoch()} if signed or fleet.announces(name, "getStatus", "nonce") else {}


def status_report(
    name: str, answer: Mapping[str, Any], took_ms: float, key: bytes | None, asked: Mapping[str, str]
) -> LockoutReport:
    """Return the lockouts in an answer to getStatus.

    Args:
        key: the enrolled one, or None.
        asked: the arguments of the question, its nonce where the robot is enrolled.
    """
    if "locked" not in answer:
        return LockoutReport(name, problem="it does not report lockouts", facts=answer, round_trip_ms=took_ms)
    rows = answer.get("lockout")
    lockouts = tuple(Lockout.of(each) for each in rows if isinstance(each, Mapping)) if isinstance(rows, list) else ()
    stated = {"locked": answer["locked"], "epochs": [each.epoch for each in lockouts], **asked}
    problem = distrust(Purpose.LOCKOUT_STATE, name, answer.get("statement"), key, stated)
    return LockoutReport(name, () if problem else lockouts, problem, answer, took_ms)


def resume_robots(
    fleet: FleetClient, found: Sequence[LockoutReport], signer: Any, seconds: float
) -> dict[str, Resumed]:
    """Sign and send a resume of every lockout; return each robot's outcome."""
    keys = enrolled_keys(fleet.link)
    by_epoch: dict[str, list[str]] = {}
    for robot in found:
        for lockout in robot.lockouts:
            if lockout.epoch != OVERFLOW:
                by_epoch.setdefault(lockout.epoch, []).append(robot.name)
    assertions: dict[str, list[dict[str, Any]]] = {}
    for epoch, names in by_epoch.items():
        for assertion in sign(signer, epoch, names):
            for name in assertion["targets"]:
                assertions.setdefault(name, []).append(assertion)
    outcomes = {robot.name: _before_resume(robot) for robot in found}
    # All robots at once, and the lockouts of each one after the other, until it refuses.
    left = {each.name: assertions.get(each.name, []) for each in found if each.lockouts and not each.problem}
    while sent := {name: waiting[0] for name, waiting in left.items() if waiting}:
        calls = {name: {"assertion": assertion} for name, assertion in sent.items()}
        for name, (answer, _) in fleet.call_each(calls, "resume", seconds).items():
            goes_on, outcomes[name] = _resumed(name, answer, sent[name], keys.get(name))
            left[name] = left[name][1:] if goes_on else []
    return outcomes


def _before_resume(robot: LockoutReport) -> Resumed:
    """Return the outcome of a resume where none can be sent to a robot."""
    if robot.problem:
        return False, robot.problem
    if not robot.lockouts:
        return True, "was not locked"
    return False, TOO_MANY


def _resumed(
    name: str, answer: Envelope | Exception, assertion: Mapping[str, Any], key: bytes | None
) -> tuple[bool, Resumed]:
    """Return True where its next lockout may be resumed, and the outcome."""
    if isinstance(answer, Exception):
        return False, (False, plain_text(str(answer.args[0] if answer.args else answer), 2000))
    stated = {"status": answer.get("status"), "nonce": assertion["nonce"]}
    stated |= {"locked": answer["locked"]} if "locked" in answer else {}
    problem = distrust(Purpose.RESUME_ANSWER, name, answer.get("statement"), key, stated)
    if problem:
        return False, (False, problem)
    if answer.get("status") != "success":
        return False, (False, f"{text_of(answer)}: its own audit says why")
    return True, (answer.get("locked") is False, text_of(answer))


def usable_keys(link: LinkConfig) -> Keys:
    """Return the enrolled keys; None, and a log record, where they cannot be used."""
    try:
        return enrolled_keys(link)
    except KeyFileError as exc:
        logger.critical("No answer counts as a robot's own: %s", exc)
        return None
