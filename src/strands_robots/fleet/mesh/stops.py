"""Stops of all peers, their lockouts and resumes; safety controllers of the mesh."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import TYPE_CHECKING, Any

from strands_robots.bounded_json import json_object
from strands_robots.envelope import Envelope, error, success
from strands_robots.fleet.adapter import TOO_MANY, LockoutReport, Resumed, StopRequest
from strands_robots.fleet.mesh.peers import LOOK_S, discover, must_answer, only_calls
from strands_robots.fleet.shared_id import Keys
from strands_robots.fleet.verdicts import measured, stop_outcome, unanswered
from strands_robots.safety.answers import Answer, OnProgress, Press, Presses, Progress, StopReport
from strands_robots.safety.controller import DEADLINE_S
from strands_robots.safety.lockout import OVERFLOW, Lockout
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import PARSED_MAX_BYTES, new_epoch
from strands_robots.safety.resume import sign
from strands_robots.safety.roster import OnReport, Roster, RosterInbox, Sending
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.sightings import RosterRow
from strands_robots.safety.standing_roster import StandingRoster, controllers_identity
from strands_robots.safety.statements import (
    ALARM,
    enrolled_key,
    enrolled_peers,
    lockout_distrust,
    resume_distrust,
    stop_distrust,
)
from strands_robots.safety.stop_link import ESTOP
from strands_robots.safety.stop_roster import READ_WITHIN_S, StopOutcome, StopRoster, robots_known_at
from strands_robots.safety.stopping import explain, grade
from strands_robots.utils import plain_text, shown

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh
    from strands_robots.mesh.transport import Sample

PARALLEL_REQUESTS = 64
"""Peers that are asked at a time: so many silent ones keep no other one waiting."""

RELAYED_S = 1.0
"""Seconds in which a resume reaches all robots from the first one, before each is asked by itself."""


def lockable_peers(mesh: Mesh) -> list[str]:
    """Return the peers in reach that have a robot, without a world's children."""
    rows = {row["peer_id"]: row for row in mesh.peers if row["reachable"]}
    return [
        name
        for name, row in rows.items()
        if ("locked" in row or "tool_name" in row) and name.rpartition("__")[0] not in rows
    ]


def ask_peers(mesh: Mesh, names: Iterable[str], seconds: float) -> list[LockoutReport]:
    """Ask each peer for its status, in parallel.

    An enrolled robot whose answer is not its own has a ``problem``.
    """
    wanted, keys = list(dict.fromkeys(names)), enrolled_peers()
    with ThreadPoolExecutor(PARALLEL_REQUESTS) as pool:
        return list(pool.map(lambda name: ask_peer(mesh, name, seconds, keys), wanted))


def ask_peer(mesh: Mesh, name: str, seconds: float, keys: Keys) -> LockoutReport:
    """Ask one peer for its status.

    Args:
        mesh: the peer that asks.
        name: the peer that is asked.
        seconds: in which it has to answer.
        keys: enrolled ones; without any no answer counts.
    """
    began = time.monotonic()
    nonce = new_epoch() if keys and enrolled_key(name, keys) else ""
    reply = mesh.send(name, {"action": "status", **({"nonce": nonce} if nonce else {})}, seconds)
    took_ms = (time.monotonic() - began) * 1000
    result = reply.get("result")
    if reply.get("type") != "response" or not isinstance(result, Mapping):
        return LockoutReport(name, problem=shown(reply["error"]) if reply.get("error") else "no answer")
    rows = result.get("lockout")
    if not isinstance(rows, list):
        return LockoutReport(name, problem="it does not report lockouts", facts=result, round_trip_ms=took_ms)
    lockouts = tuple(Lockout.of(each) for each in rows if isinstance(each, Mapping))
    distrusted = lockout_distrust(name, result, [each.epoch for each in lockouts], keys, nonce)
    problem = distrusted or str(result.get("estop_unheard", ""))
    return LockoutReport(name, () if distrusted else lockouts, problem, result, took_ms)


def resume_peers(mesh: Mesh, found: Sequence[LockoutReport], signer: Any, seconds: float) -> dict[str, Resumed]:
    """Resume every epoch of these peers; return each one's outcome.

    A resume is sent to one of its targets, which relays it. A robot that is still locked then gets a resume of its own.
    """
    locked = {each.name: each.lockouts for each in found if not each.problem}
    names: dict[str, list[str]] = {}
    for name, lockouts in locked.items():
        for each in lockouts:
            names.setdefault(each.epoch, []).append(name)
    said: dict[str, str] = {}
    for epoch in names.keys() - {OVERFLOW}:
        for assertion in sign(signer, epoch, names[epoch]):
            first = assertion["targets"][0]
            said[first] = _send(mesh, first, assertion, seconds)
    left = _still_locked(mesh, locked, RELAYED_S)
    for name, lockouts in left.items():
        for each in lockouts:
            for assertion in sign(signer, each.epoch, [name]) if each.epoch != OVERFLOW else ():
                said[name] = _send(mesh, name, assertion, seconds)
    left = _still_locked(mesh, left, seconds) if left else left
    return {
        name: (name not in left, _outcome(lockouts, left.get(name), said.get(name, "")))
        for name, lockouts in locked.items()
    } | {each.name: (False, each.problem) for each in found if each.problem}


def _still_locked(
    mesh: Mesh, locked: Mapping[str, tuple[Lockout, ...]], within: float
) -> dict[str, tuple[Lockout, ...]]:
    """Ask until all are free, at most ``within`` seconds; return those that are not."""
    left = {name: lockouts for name, lockouts in locked.items() if lockouts}
    deadline = time.monotonic() + within
    while left:
        answers = ask_peers(mesh, left, within)
        left = {each.name: each.lockouts or left[each.name] for each in answers if each.lockouts or each.problem}
        if time.monotonic() >= deadline:
            break
        time.sleep(0.05)
    return left


def _outcome(before: tuple[Lockout, ...], left: tuple[Lockout, ...] | None, said: str) -> str:
    if left is None:
        return "free to move when told to" if before else "was not locked"
    if any(each.epoch == OVERFLOW for each in left):
        return TOO_MANY
    return f"{said or 'it did not confirm'}: its own audit says why"


def _send(mesh: Mesh, name: str, assertion: Mapping[str, Any], seconds: float) -> str:
    reply = mesh.send(name, {"action": "resume", "assertion": assertion}, seconds)
    result = reply.get("result")
    if not isinstance(result, Mapping):
        return str(reply.get("error") or "no answer")
    return resume_distrust(name, assertion, result, enrolled_peers()) or str(result.get("error", ""))


REPORTS, STOPS = "missed rosters", "stops of others"
"""Names of the subscriptions."""

_subscriptions = count()


def mesh_network() -> NetworkKey:
    """Return the key of the mesh that this process joins."""
    from strands_robots.mesh.session import network  # noqa: PLC0415 - the network is loaded when it is used

    return network()


class MeshReports:
    """Reports of standing controllers about the stops of one peer.

    Args:
        mesh: the peer.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh, self.inbox = mesh, RosterInbox(_fields)
        # Of two with one name the later would end the earlier one's.
        self._name = f"{REPORTS} {next(_subscriptions)}"

    def begin(self) -> None:
        """Receive reports from now on."""
        from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

        self._mesh.listen(topics.missed_roster("*"), self._take, self._name)

    def close(self) -> None:
        """Receive none any more."""
        self._mesh.unsubscribe(self._name)
        self.inbox.end()

    def _take(self, sample: Sample) -> None:
        self.inbox.put(sample.key.split("/")[1], sample.payload)


def stand_on_mesh(mesh: Mesh, signing_key: Any, also: Callable[[], Collection[str]] = tuple) -> StandingRoster:
    """Have a peer without a robot report whom it misses after a stop of another one.

    Args:
        mesh: the peer.
        signing_key: of its e-stops, or None.
        also: returns names that it shows besides its roster.
    """
    from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - as above
    from strands_robots.mesh.wire import WireError  # noqa: PLC0415 - as above

    where = mesh_network()

    def publish(fields: Mapping[str, Any]) -> None:
        with contextlib.suppress(TransportError, WireError):  # a link that is down carries no report
            mesh.publish(topics.missed_roster(mesh.peer_id), dict(fields))

    def unlocked(estop_id: str, rows: Mapping[str, RosterRow]) -> list[str]:
        peers, keys = mesh.peers_by_id, enrolled_peers()
        return [name for name in rows if not _locked(name, peers.get(name, {}), estop_id, keys)]

    standing = StandingRoster(
        mesh.peer_id,
        publish,
        roster=lambda: Roster.of(where),
        keys=dict,
        identity=functools.cache(lambda: controllers_identity(mesh.peer_id, signing_key)),
        also=also,
        read=_stop,
        unanswered=unlocked,
    )
    mesh.listen(topics.estop(), lambda sample: standing.hear(ESTOP, str(sample.session), sample.payload), STOPS)
    return standing


def _fields(payload: bytes) -> Mapping[str, Any]:
    return json_object(payload, PARSED_MAX_BYTES)


def _stop(sender: str, payload: bytes) -> tuple[str, Mapping[str, Any]]:
    body = json_object(payload, PARSED_MAX_BYTES)
    return str(body.get("peer_id", ""))[:128], body


def _locked(name: str, row: Mapping[str, Any], estop_id: str, keys: Mapping[str, bytes] | None) -> bool:
    """Return True for a peer that announces this lockout."""
    epochs = row.get("epochs")
    if not isinstance(epochs, list) or estop_id not in epochs or row.get("reachable") is not True:
        return False
    return not lockout_distrust(name, row, epochs, keys)


ESTOP_S = 1.5
"""Seconds in which peers answer a stop; it is repeated until then."""

REPORTED_S = 0.5
"""Seconds from an emergency stop in which standing controllers report whom they miss: their first two reports."""

AGAIN_S = 1.0
"""Seconds between two sendings of a stop that a peer in reach has not confirmed."""


def stop_peers(mesh: Mesh, since: float | None = None) -> tuple[dict[str, Envelope], StopOutcome]:
    """Stop every peer in reach; return answers and outcome.

    Args:
        mesh: the peer that stops them.
        since: when it joined, in monotonic seconds; just now by default, so that the others are waited for.
    """
    roster = StopRoster(mesh_network())
    answers = _stop_all(mesh, lambda: mesh.broadcast({"action": "stop"}, ESTOP_S), roster, since)
    outcome = measured(answers, roster, Sending())
    outcome.record(mesh.peer_id)
    return answers, outcome


def lock_peers(mesh: Mesh, request: StopRequest, since: float | None = None) -> StopOutcome:
    """Send the mesh's emergency stop, again while a peer has not confirmed it.

    A peer that was seen and did not answer is named. Every repetition is the same stop.

    Args:
        mesh: the peer that sends it.
        request: the stop.
        since: as in :func:`stop_peers`.
    """
    reports = MeshReports(mesh)
    roster = StopRoster(mesh_network(), request.named, request.scope)
    reports.inbox.open(request.estop_id, roster.take)
    listening: list[threading.Thread] = []

    def left(replies: list[dict[str, Any]]) -> None:
        if not listening:
            listening.append(threading.Thread(target=reports.begin, name="missed rosters", daemon=True))
            listening[0].start()

    def send() -> list[dict[str, Any]]:
        some: dict[str, Any] = {}
        if not roster.scope.everything:
            known = request.remembers or robots_known_at(mesh_network)
            some = {"scope": roster.scope, "remembers": known, "on_widened": roster.widen}
        return mesh.emergency_stop(
            request.signing_key, reason=request.reason, estop_id=request.estop_id, on_answers=left, **some
        )

    sent = time.monotonic()
    try:
        answers = _stop_all(mesh, send, roster, since)
        # Also where all in reach have answered: other consoles say whom they miss.
        time.sleep(max(0.0, sent + REPORTED_S - time.monotonic()))
    finally:
        reports.close()
    outcome = measured(answers, roster, Sending(signed=request.signing_key is not None), request.estop_id)
    outcome.record(mesh.peer_id)
    return outcome


def stop_peer(mesh: Mesh, robot: str, seconds: float, robot_name: str = "") -> Envelope:
    """Stop one peer, or one robot of its world; return the answer.

    *Stopped* counts only where an enrolled robot has signed it. Of a silent peer ``in_reach`` says whether it was seen.
    """
    one = {"robot_name": robot_name} if robot_name else {}
    answer = stop_answer(robot, mesh.send(robot, {"action": "stop", **one}, seconds), enrolled_peers())
    return {**answer, "in_reach": mesh.get_peer(robot) is not None} if answer == unanswered(robot) else answer


def stop_answer(
    target: str, reply: Mapping[str, Any], keys: Mapping[str, bytes] | None, *, locks: Collection[str] = ()
) -> Envelope:
    """Return a reply to a stop as an envelope.

    *Stopped* counts only where an enrolled robot has signed it.

    Args:
        target: the peer's id.
        reply: as the mesh returns it.
        keys: enrolled keys by peer; None where they could not be read.
        locks: robots that an emergency stop was for, each of which has to say that it is locked.
    """
    if "result" not in reply and reply.get("type") != "error":
        return unanswered(target)
    result = reply.get("result")
    if not grade(result).stopped:
        return error(explain(result) if result is not None else plain_text(reply.get("error")), stopped=False)
    why = stop_distrust(reply, keys)
    if why:
        return error(why, stopped=False if why.startswith(ALARM) else None)
    fields = result if isinstance(result, Mapping) else {}
    free = target in locks and fields.get("locked") is not True
    said = "stopped, and NOT LOCKED: its release knows no lock by command" if free else "stopped"
    # The mesh lists under `stopped` what was halted.
    halted = fields.get("halted", fields.get("stopped"))
    return {**fields, "halted": halted, **success(said, stopped=True)}


def _stop_all(
    mesh: Mesh, stop: Callable[[], list[dict[str, Any]]], roster: StopRoster, since: float | None
) -> dict[str, Envelope]:
    """Send a stop, and again while a peer in reach has not confirmed it.

    Args:
        mesh: the peer that stops them.
        stop: sends it once; returns the replies.
        roster: read once it has left, and given the peers in reach.
        since: when this peer joined, in monotonic seconds; just now for None.
    """
    seen: set[str] = set()
    replies: dict[str, dict[str, Any]] = {}
    answers: dict[str, Envelope] = {}
    keys: list[Mapping[str, bytes] | None] = []
    sent = time.monotonic()

    def read() -> None:
        try:
            keys.append(enrolled_peers())
        finally:
            roster.read()

    def send() -> None:
        nonlocal sent
        sent = time.monotonic()
        replies.update({each["responder_id"]: each for each in stop() if each["responder_id"] != mesh.peer_id})

    def graded() -> dict[str, Envelope]:
        while keys and replies:
            name, reply = replies.popitem()
            answers[name] = stop_answer(name, reply, keys[0], locks=roster.scope.only)
        return answers

    def unconfirmed() -> bool:
        seen.update(name for name in must_answer(mesh) if roster.scope.covers(name, _cells(mesh, name)))
        return any(not graded().get(name, {}).get("stopped") for name in seen)

    send()
    # On a thread: a disk that hangs delays no further sending.
    reading = threading.Thread(target=read, name="stop roster", daemon=True)
    reading.start()
    discover(mesh, lambda: send() if unconfirmed() and time.monotonic() - sent >= AGAIN_S else None, since=since)
    if unconfirmed():
        send()
    reading.join(READ_WITHIN_S)
    keys.append(None)  # not read in time: no answer counts as proven
    roster.find(dict.fromkeys(seen, True), {name: next(iter(_cells(mesh, name)), "") for name in seen})
    callers = {row["peer_id"] for row in mesh.peers if only_calls(row)}
    # A program without a robot has nothing to stop; one that says that something moves is heard all the same.
    robots = {name: said for name, said in graded().items() if name not in callers or said.get("stopped") is False}
    return {name: unanswered(name) for name in seen} | robots


def _cells(mesh: Mesh, peer: str) -> frozenset[str]:
    cell = next((row.get("cell") for row in mesh.peers if row["peer_id"] == peer), None)
    return frozenset({cell} if isinstance(cell, str) and cell else ())


class MeshController:
    """A safety controller whose stops and check-ins travel on the mesh.

    Args:
        mesh: the peer that sends them, under its own id; it may have joined just now.
        signing_key: Ed25519 private key, for fleets that act on signed stops only.
    """

    def __init__(self, mesh: Mesh, signing_key: Any = None) -> None:
        from strands_robots.mesh.transport.config import DISCOVERY_S  # noqa: PLC0415 - the network is loaded when it is used

        self._mesh = mesh
        self._key = signing_key
        self._presses = Presses()
        self._keys = enrolled_peers()
        self._named: dict[str, frozenset[str]] = {}
        self.controller_id, self.network = mesh.peer_id, mesh_network()
        self.sending = Sending(signed=signing_key is not None)
        self._reports = MeshReports(mesh)
        self._reports.begin()
        self._known_at = time.monotonic() + DISCOVERY_S

    @property
    def link_up(self) -> bool:
        """True while this peer is on the mesh, and linked to its hub."""
        from strands_robots.mesh import session  # noqa: PLC0415 - the network is loaded when it is used

        return self._mesh.alive and not session.cut_off()

    def press(self, estop_id: str) -> Press:
        """Note the moment of a press, from which its answers are counted."""
        return self._presses.note(estop_id)

    def check_in_every(self, interval_s: float) -> None:
        """Check in with the robots that need a live controller."""
        self._mesh.check_in_every(interval_s, self._key)

    def stop(
        self,
        expected: Collection[str] = (),
        reason: str = "",
        *,
        estop_id: str = "",
        more: bool = False,
        on_progress: OnProgress = lambda progress: None,
        on_report: OnReport = lambda report: None,
        scope: Scope = EVERY_ROBOT,
    ) -> StopReport:
        """Stop every peer of the mesh, or those of ``scope``, and wait at most 3 s.

        Where no robot in the scope is there, every robot is stopped.
        """
        epoch = estop_id or new_epoch()
        pressed = self.press(epoch)
        self._named[epoch] = frozenset(expected) | scope.only
        answers: dict[str, Answer] = {}
        alarms: dict[str, str] = {}
        widened: list[bool] = []

        def note(replies: list[dict[str, Any]]) -> None:
            for reply in replies:
                name, why = str(reply["responder_id"]), stop_distrust(reply, self._keys)
                if why.startswith(ALARM):
                    alarms[name] = why
                elif name not in answers or answers[name].stopped is not True or answers[name].claimed:
                    answers[name] = _answer(name, reply, (time.monotonic() - pressed.at) * 1000, claimed=bool(why))
            silent = tuple(sorted(self._named[epoch] - answers.keys()))
            elapsed = (time.monotonic() - pressed.at) * 1000
            on_progress(
                Progress(
                    epoch,
                    dict(answers),
                    silent,
                    self.link_up,
                    elapsed,
                    alarms=dict(alarms),
                    scope=scope,
                    widened=bool(widened),
                )
            )

        until = time.monotonic() + DEADLINE_S
        self._reports.inbox.open(epoch, on_report)
        # On a thread: a disk that hangs delays no sending.
        reading = threading.Thread(target=self._load_keys, name="enrolled keys", daemon=True)
        reading.start()

        def send() -> list[dict[str, Any]]:
            return self._mesh.emergency_stop(
                self._key,
                reason=reason,
                estop_id=epoch,
                on_answers=note,
                scope=scope,
                remembers=robots_known_at(mesh_network),
                on_widened=lambda: widened.append(True),
            )

        replies = send()
        if time.monotonic() < self._known_at:
            # Peers that this one did not know yet have stopped, and were not waited for.
            time.sleep(max(0.0, self._known_at - time.monotonic()))
            replies = send()
        up = self.link_up
        # Without a hub nothing left; a stop that goes on is sent again in the moment it is back.
        while not up and not self.link_up and time.monotonic() < until:
            time.sleep(LOOK_S)
        self._reports.inbox.close(epoch)
        reading.join(READ_WITHIN_S)
        # By the keys of now: a robot may have been enrolled since the last stop.
        answers.clear()
        note(replies)
        expected = self._named.pop(epoch)
        robots = {*expected, *lockable_peers(self._mesh)}
        told = {name: each for name, each in answers.items() if name in robots}
        return StopReport(
            epoch,
            {name: each for name, each in told.items() if each.stopped is True and not each.claimed},
            {name: each for name, each in told.items() if each.stopped is not True},
            {},
            tuple(sorted(expected - told.keys() - alarms.keys())),
            up,
            (time.monotonic() - pressed.at) * 1000,
            claimed={name: each for name, each in told.items() if each.stopped is True and each.claimed},
            alarms=alarms,
            scope=scope,
            widened=bool(widened),
        )

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer; the mesh asks those in reach by itself."""
        named = self._named.get(estop_id)
        if named is None:
            return False
        self._named[estop_id] = named | frozenset(names)
        return True

    def _load_keys(self) -> None:
        self._keys = enrolled_peers()

    def review(self, report: StopReport) -> StopReport:
        """Return the report as it is: a peer answers a stop once."""
        return report


def _answer(name: str, reply: dict[str, Any], latency_ms: float, *, claimed: bool) -> Answer:
    result = reply.get("result")
    if reply.get("type") != "response" or not isinstance(result, dict):
        return Answer(name, None, latency_ms, str(reply.get("error", "no answer")))
    stopped, _ = stop_outcome(result)
    why = "" if stopped else explain(result)
    return Answer(name, stopped, latency_ms, why, result, required=claimed, enrolled=claimed)
