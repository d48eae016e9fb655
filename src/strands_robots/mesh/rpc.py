"""Requests to other peers: turns, and the checks of their replies."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Any

from strands_robots.mesh import session, topics, wire, wire_identity
from strands_robots.mesh.security import validate_command
from strands_robots.mesh.session import ASK_AGAIN_S, COMMANDS_S, Attribution, Context, attribute
from strands_robots.mesh.transport import Sample, TransportError
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stopping import Outcome, grade
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.verbs import Kind
from strands_robots.utils import RESERVED_IDS, ValidationError, finite, mapping, number, shown

logger = logging.getLogger(__name__)

OFFLINE = "offline"
BROADCAST_RESPONDER = "\x00broadcast"
"""Expected responder of a broadcast; the NUL keeps it apart from every peer id."""

REPLIES_MAX = 4096

PURPOSES = {"status": Purpose.LOCKOUT_STATE, "resume": Purpose.RESUME_ANSWER, "stop": Purpose.STOP_VERDICT}
"""Actions whose answer a robot signs, with the purpose of the signature."""

OURS: Mapping[str, frozenset[str]] = {"status": frozenset({"nonce"}), "teleop_stop": frozenset({"source_peer_id"})}
"""Fields of reads that 0.5 releases do not know, by action."""

EVERY_PEER = "all"
"""Stands for the target of a broadcast."""

_NO_ID = frozenset("/*$?#")
LOOK_S = 0.02
REPEAT_S = 0.5
"""Seconds after which an unanswered stop is sent again: its message or its answer may be lost."""


@dataclass(slots=True)
class Turn:
    """One pending request.

    A request that is sent again has another id: a receiver refuses the second command of one id as a replay.

    Attributes:
        expected: id of the responder, or :data:`BROADCAST_RESPONDER`.
        command: as it was sent.
        ids: every id that the request was sent under.
        arrived: the replies that count, in order, and None when the mesh was stopped.
        via: ``direct`` where the transport reports whether the topic has subscribers, else ``publish``.
        confirmed: the transport reported a subscriber.
    """

    expected: str
    command: Mapping[str, Any] = field(default_factory=dict)
    ids: list[str] = field(default_factory=list)
    arrived: SimpleQueue[dict[str, Any] | None] = field(default_factory=SimpleQueue)
    answered: set[tuple[str | None, str, str]] = field(default_factory=set)
    via: str = "publish"
    confirmed: bool = False

    def next(self, seconds: float) -> dict[str, Any] | None:
        """Wait for the next reply. Raises Empty after ``seconds`` without one."""
        return self.arrived.get(timeout=min(seconds, threading.TIMEOUT_MAX))

    def delivery(self) -> dict[str, Any]:
        """The fields that report the delivery of the command to its sender."""
        return {"via": self.via, "confirmed": self.confirmed}


class Requester:
    """Sends commands and collects replies for one peer."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._turns: dict[str, Turn] = {}
        self._lock = threading.Lock()

    def send(self, target: object, command: object, timeout: object) -> dict[str, Any]:
        """Return the raw reply, or status ``timeout``, or status ``error``.

        ``via`` and ``confirmed`` report the delivery, and replace fields of these names in the reply.
        """
        prepared = self._prepare(target, command, timeout)
        if isinstance(prepared, str):
            return refused(prepared)
        peer, clean, seconds = prepared
        turn = Turn(peer, clean)
        try:
            problem = self._publish(topics.command(peer), clean, turn, seconds)
            if problem is not None:
                return refused(problem) | (turn.delivery() if problem == OFFLINE else {})
            reply = self._answer(turn, clean, seconds)
            return (reply or refused("the mesh was stopped while the reply was awaited.")) | turn.delivery()
        except Empty:
            return {"status": "timeout", "target": peer, "turn_id": turn.ids[0], **turn.delivery()}
        finally:
            self._close(turn)

    def _answer(self, turn: Turn, command: dict[str, Any], seconds: float) -> dict[str, Any] | None:
        """Wait for the reply; ask for a stop again, and towards a 0.5 peer for a read."""
        deadline = time.monotonic() + seconds
        kind = kind_of_action(command)
        while True:
            left = max(0.0, deadline - time.monotonic())
            pause = REPEAT_S if kind is Kind.STOP else left
            if kind in (Kind.STOP, Kind.READ) and self._context.registry.older():
                pause = ASK_AGAIN_S
            try:
                return turn.next(min(left, pause))
            except Empty:
                if left <= pause:
                    raise
                self._publish(topics.command(turn.expected), command, turn)

    def ping(self, target: object, timeout: object) -> dict[str, Any]:
        """Ping a peer and return status, round trip in milliseconds and delivery."""
        started = time.perf_counter()
        reply = self.send(target, {"action": "ping"}, timeout)
        latency = round((time.perf_counter() - started) * 1000, 3)
        via = reply.get("via")
        if reply.get("error") == OFFLINE and "type" not in reply:
            return {"status": OFFLINE, "latency_ms": latency, "via": via, "reason": OFFLINE}
        if reply.get("status") == "error" and "type" not in reply:
            return reply
        if reply.get("status") == "timeout":
            return {"status": "timeout", "latency_ms": latency, "via": via}
        if reply.get("type") == "error":
            return {"status": "error", "error": reply.get("error", ""), "latency_ms": latency, "via": via}
        return {"status": "ok", "latency_ms": latency, "via": via, "confirmed": reply["confirmed"]}

    def broadcast(
        self, command: object, timeout: object, missing: Callable[[list[dict[str, Any]]], set[str]] | None = None
    ) -> list[dict[str, Any]]:
        """Return the replies within ``timeout``; ``[]`` for a refused precondition.

        Args:
            missing: returns the peers still to answer, given the results so far. The collection ends when there is
                none, and until then the command is sent to each of them again twice a second. A peer's result
                replaces an error of it.
        """
        prepared = self._prepare(EVERY_PEER, command, timeout)
        if isinstance(prepared, str):
            logger.warning("broadcast: %s", prepared)
            return []
        _, clean, seconds = prepared
        turn = Turn(BROADCAST_RESPONDER, clean)
        try:
            problem = self._publish(topics.broadcast(), clean, turn)
            if problem is not None:
                logger.warning("broadcast: %s", problem)
                return []
            older = self._context.registry.older()
            pause = ASK_AGAIN_S if older else REPEAT_S

            def absent(replies: Iterable[dict[str, Any]]) -> set[str]:
                return missing([each for each in replies if each["type"] == "response"]) if missing else set()

            def send(replies: Mapping[str, dict[str, Any]]) -> None:
                left = absent(replies.values())
                # Towards a peer of a 0.5 release each of them would wait for the one before it.
                keys = [topics.broadcast()] if older and len(left) > 1 else [topics.command(peer) for peer in left]
                for key in keys:
                    self._publish(key, clean, turn)

            return self._collect(
                turn,
                seconds,
                lambda replies: missing is None or bool(absent(replies)),
                send,
                every_s=pause,
                first_s=seconds if missing is None else pause,
            )
        finally:
            self._close(turn)

    def stop_each(
        self,
        stops: Callable[[], Mapping[str, dict[str, Any]]],
        seconds: float,
        goes_on: Callable[[list[dict[str, Any]]], bool],
    ) -> list[dict[str, Any]]:
        """Send each peer a stop of its own, and collect the replies.

        Args:
            stops: returns the stop of each peer that has to answer. It is asked, and a peer without a result gets the
                stop again, every ``ASK_AGAIN_S``.
            goes_on: ends the collection; it gets the replies so far, many times a second.
        """
        turn = Turn(BROADCAST_RESPONDER)

        def send(replies: Mapping[str, dict[str, Any]]) -> None:
            for peer, command in stops().items():
                if replies.get(peer, {}).get("type") != "response":
                    self._publish(topics.command(peer), command, turn)

        try:
            return self._collect(turn, seconds, goes_on, send, every_s=ASK_AGAIN_S, look_s=LOOK_S)
        finally:
            self._close(turn)

    def _collect(
        self,
        turn: Turn,
        seconds: float,
        goes_on: Callable[[list[dict[str, Any]]], bool],
        send: Callable[[Mapping[str, dict[str, Any]]], None],
        *,
        every_s: float,
        first_s: float = 0.0,
        look_s: float = math.inf,
    ) -> list[dict[str, Any]]:
        """Return the replies of one turn; a peer's result replaces an error of it.

        Args:
            goes_on: ends the collection, given the replies so far.
            send: sends the command again, given the replies by peer; after ``first_s`` and then every ``every_s``.
            look_s: seconds between two questions of ``goes_on``, where no reply comes.
        """
        replies: dict[str, dict[str, Any]] = {}
        now = time.monotonic()
        deadline, due = now + seconds, now + first_s
        while now < deadline:
            if now >= due:
                send(replies)
                due = time.monotonic() + every_s
            if not goes_on(list(replies.values())):
                break
            with contextlib.suppress(Empty):  # no answer in this interval
                reply = turn.next(max(0.0, min(deadline, due, now + look_s) - now))
                if reply is None:
                    break
                peer = str(reply["responder_id"])
                if peer not in replies or (replies[peer]["type"], reply["type"]) == ("error", "response"):
                    replies[peer] = reply
            now = time.monotonic()
        return list(replies.values())

    def on_response(self, sample: Sample) -> None:
        """Take a sample on our response topic: count it, or refuse and audit it."""
        context = self._context
        try:
            body = wire.decode(sample.payload, topics.BY_NAME["response"].max_bytes)
            reply = wire.Reply.of(body)
        except wire.WireError as exc:
            context.audit("response_malformed", reason=str(exc))
            return
        with self._lock:
            turn = self._turns.get(reply.turn_id)
        if turn is None:
            return
        why = self._hijack_reason(sample, reply, turn)
        if why == Attribution.UNKNOWN.value and turn.command and kind_of_action(turn.command) is Kind.STOP:
            # A stop leaves before peers are known, so that its first answer may come before the peer's presence.
            logger.debug("An answer of %s, which is not known yet, does not count.", shown(reply.responder_id))
            return
        if why is not None:
            logger.warning("A reply in the name of %s was refused: %s.", shown(reply.responder_id), why)
            context.audit("response_hijack_rejected", reply.responder_id, turn_id=reply.turn_id, reason=why)
            return
        self._count(sample, reply, turn, body)

    def close(self) -> None:
        """Wake every thread that waits for a reply."""
        with self._lock:
            turns = list(self._turns.values())
        for turn in turns:
            turn.arrived.put(None)

    def _hijack_reason(self, sample: Sample, reply: wire.Reply, turn: Turn) -> str | None:
        parts = sample.key.split("/")
        if len(parts) != 5:
            return "the legacy key names no responder"
        if parts[3] != reply.responder_id or parts[4] != reply.turn_id:
            return "the topic and the body disagree"
        if turn.expected not in (BROADCAST_RESPONDER, reply.responder_id):
            return "it is not the peer that the request was for"
        context = self._context
        attribution = attribute(context.registry.session_of(reply.responder_id), sample)
        if not attribution.accepted:
            return attribution.value
        if context.identity.required:
            return context.identity.refusal(reply.body, reply.responder_id)
        return None

    def _count(self, sample: Sample, reply: wire.Reply, turn: Turn, body: dict[str, Any]) -> None:
        responder = (sample.session, reply.responder_id, reply.turn_id)
        with self._lock:
            duplicate = responder in turn.answered
            counts = not duplicate and len(turn.answered) < REPLIES_MAX
            if counts:
                turn.answered.add(responder)
        if counts:
            body.pop("sig", None)
            self._remember(sample, reply, turn, body.get("result"))
            turn.arrived.put(body)
        if duplicate:
            self._context.audit("response_duplicate_rejected", reply.responder_id, turn_id=reply.turn_id)

    def _remember(self, sample: Sample, reply: wire.Reply, turn: Turn, result: object) -> None:
        """Have this machine remember a robot that answered, signed."""
        purpose = PURPOSES.get(str(turn.command.get("action")))
        statement = result.get("statement") if isinstance(result, Mapping) else None
        if purpose is None or statement is None or self._context.registry.of_world(reply.responder_id, sample.session):
            return
        assertion = turn.command.get("assertion")
        asked = assertion if isinstance(assertion, Mapping) else turn.command
        expected = {"nonce": asked["nonce"]} if "nonce" in asked else {}
        if purpose is Purpose.STOP_VERDICT:
            expected = {"turn_id": reply.turn_id}
        sightings().note_answer(session.network(), reply.responder_id, purpose, statement, expected)

    def _prepare(self, target: object, command: object, timeout: object) -> tuple[str, dict[str, Any], float] | str:
        if self._context.transport is None:
            return "the mesh is not running."
        if not isinstance(target, str) or not target or "\x00" in target:
            return f"target must be a non-empty string without NUL, not {shown(target)}."
        try:
            clean = self._own_command(target, command) or validate_command(command)
            seconds = number("timeout", timeout, above=0)
        except ValidationError as exc:
            return f"validation: {exc}"
        if not _NO_ID.isdisjoint(target) or target in RESERVED_IDS:
            return f"target must be a peer id, not {shown(target)}."
        return target, self._read_by(target, clean), seconds

    def _read_by(self, target: str, command: dict[str, Any]) -> dict[str, Any]:
        """Return a read without the fields that a 0.5 release would refuse it for.

        They go to peers alone that have announced themselves as ours; a broadcast reaches every peer.
        """
        new = OURS.get(command["action"])
        registry = self._context.registry
        if new is None or new.isdisjoint(command):
            return command
        if registry.knows_ours(target) or (target == EVERY_PEER and not registry.older()):
            return command
        return {name: value for name, value in command.items() if name not in new}

    def _own_command(self, target: str, command: object) -> dict[str, Any] | None:
        """Return the command of a robot's own verb; None for any other.

        The robot announces its own verbs, and checks its arguments.
        """
        action = command.get("action") if isinstance(command, Mapping) else None
        if not isinstance(command, Mapping) or not isinstance(action, str) or action in PEER_VERBS:
            return None
        if action not in own_verbs_of(self._context.registry.get(target)):
            return None
        given = mapping("command", dict(command))
        finite("command", given)
        return given

    def _publish(self, key: str, command: dict[str, Any], turn: Turn, seconds: float | None = None) -> str | None:
        context = self._context
        target = wire.BROADCAST_TARGET if key == topics.broadcast() else key.split("/")[1]
        request = wire.Request(context.peer_id, self._open(turn), command, context.clock(), target_id=target)
        body = request.to_wire()
        if kind_of_action(command) is Kind.MOTION:
            body = context.console.sign(body, wire_identity.MOTION)
        try:
            body = context.identity.sign(body)
            transport = context.transport
            if seconds is not None and transport is not None and transport.confirms:
                turn.via = "direct"
                taken = transport.put_confirmed(key, body, seconds)
                turn.confirmed = taken is True
                return None if taken is not False else OFFLINE
            self._put(key, target, body, stop=kind_of_action(command) is Kind.STOP)
        except (wire.WireError, TransportError) as exc:
            return str(exc)
        return None

    def _put(self, key: str, target: str, body: dict[str, Any], *, stop: bool) -> None:
        """Publish a command, paced where a peer of a 0.5 release may be on its way."""
        context, kind = self._context, key.rpartition("/")[2]
        older = context.registry.older()
        if not older or (stop and target not in (*older, wire.BROADCAST_TARGET)):
            # The stop of a peer of ours waits for nobody; one that such a hub drops is repeated.
            context.put(key, body)
            context.pacer.note(kind)
            return
        with context.pacer.turn(kind, COMMANDS_S, first=stop):
            context.put(key, body)

    def _open(self, turn: Turn) -> str:
        turn_id = uuid.uuid4().hex
        with self._lock:
            turn.ids.append(turn_id)
            self._turns[turn_id] = turn
        return turn_id

    def _close(self, turn: Turn) -> None:
        with self._lock:
            for turn_id in turn.ids:
                self._turns.pop(turn_id, None)


def own_verbs_of(row: Mapping[str, Any] | None) -> frozenset[str]:
    """Return the own verbs that a peer announces, by its row of the registry."""
    names = row.get("own_verbs") if row is not None else None
    return frozenset(each for each in names if isinstance(each, str)) if isinstance(names, list) else frozenset()


def kind_of_action(command: Mapping[str, Any]) -> Kind:
    """Return the kind of a command; a verb of a robot's own counts as a motion."""
    verb = PEER_VERBS.get(command["action"])
    return Kind.MOTION if verb is None else verb.kind


def stop_outcome(reply: Mapping[str, Any]) -> Outcome:
    """Grade a raw reply to a ``stop``; what is no reply counts as no answer."""
    if reply.get("type") == "response":
        return grade(reply.get("result"))
    return Outcome.RAISED if reply.get("type") == "error" else Outcome.TIMED_OUT


def refused(why: str) -> dict[str, Any]:
    """Return the answer for a command that was not sent."""
    return {"status": "error", "error": why, "reason": why}
