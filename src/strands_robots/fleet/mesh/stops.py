"""Stops of all robots on the mesh, measured by the roster."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.fleet.mesh.discovery import discover, must_answer, only_calls
from strands_robots.fleet.mesh.standing import MeshReports, mesh_network
from strands_robots.fleet.stop_answers import measured, unanswered
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.roster import Sending
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope
from strands_robots.safety.statements import ALARM, enrolled_peers, stop_distrust
from strands_robots.safety.stop_roster import READ_WITHIN_S, StopOutcome, StopRoster, robots_known_at
from strands_robots.safety.stopping import explain, grade
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

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


def lock_peers(
    mesh: Mesh,
    signing_key: Any = None,
    scope: Scope = EVERY_ROBOT,
    *,
    reason: str = "",
    estop_id: str = "",
    since: float | None = None,
    remembers: Remembers | None = None,
    named: Collection[str] = (),
) -> StopOutcome:
    """Send the mesh's emergency stop, again while a peer has not confirmed it.

    A peer that was seen and did not answer is named. Every repetition is the same stop.

    Args:
        mesh: the peer that sends it.
        signing_key: signs it.
        scope: the robots that it is for. Where none of them is there, every robot is stopped.
        reason: sent to the peers.
        estop_id: 32 hex digits; a fresh one by default.
        since: as in :func:`stop_peers`.
        remembers: says whether a robot of ``scope`` is known; by default by this machine's roster.
        named: robots that must answer besides the roster.
    """
    epoch = estop_id or new_epoch()
    reports = MeshReports(mesh)
    roster = StopRoster(mesh_network(), named, scope)
    reports.inbox.open(epoch, roster.take)
    listening: list[threading.Thread] = []

    def left(replies: list[dict[str, Any]]) -> None:
        if not listening:
            listening.append(threading.Thread(target=reports.begin, name="missed rosters", daemon=True))
            listening[0].start()

    def send() -> list[dict[str, Any]]:
        some: dict[str, Any] = {}
        if not roster.scope.everything:
            known = remembers or robots_known_at(mesh_network)
            some = {"scope": roster.scope, "remembers": known, "on_widened": roster.widen}
        return mesh.emergency_stop(signing_key, reason=reason, estop_id=epoch, on_answers=left, **some)

    sent = time.monotonic()
    try:
        answers = _stop_all(mesh, send, roster, since)
        # Also where all in reach have answered: other consoles say whom they miss.
        time.sleep(max(0.0, sent + REPORTED_S - time.monotonic()))
    finally:
        reports.close()
    outcome = measured(answers, roster, Sending(signed=signing_key is not None), epoch)
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
