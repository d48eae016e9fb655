"""Emergency stops that a peer issues, its resumes and its check-ins.

Stops of others are received by :class:`~.stop_link.PeerStops`. Locking, halting and the check of a resume are the
safety plane's, reached through a :class:`SafetyAdapter`; :class:`EstopRetry` repeats a stop to those that missed it.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from strands_robots.audit import audit_head, own_log_id
from strands_robots.contract import Robot
from strands_robots.mesh import session, topics, wire
from strands_robots.mesh.estop_retry import KNOWN_S, Closings, EstopRetry, LatePeers, ScopedStop
from strands_robots.mesh.rpc import Requester, stop_outcome
from strands_robots.mesh.safety_adapter import SafetyAdapter
from strands_robots.mesh.session import SAFETY, SAFETY_S, Context
from strands_robots.mesh.stop_link import COMMANDED, PeerStops
from strands_robots.mesh.transport import Sample, TransportError
from strands_robots.rate_limits import RecentKeys
from strands_robots.safety import ed25519
from strands_robots.safety.checkin import CheckInAnswers, HeadWitness
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.orders import NO_REASON, StopOrder, StopRefused, new_epoch, signed_stop, stated_reason
from strands_robots.safety.resume import REJECTED, configured_keys, sign
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope, none_known
from strands_robots.safety.statements import Proof, Purpose, enrolled_peers, proof_of, record_heads
from strands_robots.safety.stop_link import ESTOP, StopEvent
from strands_robots.safety.stopping import Outcome, StopVerdict
from strands_robots.serving.control_leases import ControlLeases, control_facts
from strands_robots.serving.peer_verbs import PEER_VERBS, peer_stop_answer
from strands_robots.serving.pipeline import Own
from strands_robots.serving.verbs import Arguments
from strands_robots.serving.workers import Share, ShareFullError
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, canonical_json, identifier

logger = stop_logger(__name__)

COLLECT_S = 3.0
"""Seconds in which the answers to an e-stop are collected."""

SPACING_S = SAFETY_S
"""Between two messages on a safety topic: peers in the field let two a second through."""

RECENT_MAX = 512
SCOPED_MAX = 64
"""Stops of some robots that are repeated to those that did not confirm them."""

HEADS_PER_S = 20
"""Answers to check-ins that are read in a second; a flood of them costs no more."""

STATUS_S = 1.0
"""Seconds in which a peer in the field says whether it is locked."""

ASK_S = 1.0
"""Seconds in which peers report the epochs that a resume is signed for."""

OnAnswers = Callable[[list[dict[str, Any]]], None]
"""Gets the replies to an emergency stop so far, on the thread that collects them."""


def status_of(
    robot: Robot, facts: Callable[[str], Mapping[str, Any]], leases: Callable[[], ControlLeases | None]
) -> Own:
    """Make the ``status`` of a peer: the robot's answer, safety facts and holder.

    Args:
        facts: returns them for the nonce of the question.
        leases: returns those of the robot.
    """

    def status(arguments: Arguments, request: MotionRequest | None) -> object:
        answer = PEER_VERBS["status"].call(robot, arguments)()
        if not isinstance(answer, Mapping):
            return answer
        return {**answer, **facts(arguments.get("nonce", "")), **control_facts(leases())}

    return status


class FleetSafety:
    """Emergency stops, resumes and check-ins of one peer.

    Args:
        resumes: checks a relayed resume off the transport's thread.
        robot: this peer has one, whose answer to an e-stop comes first.
    """

    def __init__(
        self, context: Context, adapter: SafetyAdapter, requester: Requester, resumes: Share, *, robot: bool = True
    ) -> None:
        self.context = context
        self.adapter = adapter
        self._requester = requester
        self._witness, self._answers = HeadWitness(always=not robot), CheckInAnswers()
        audit_head(), own_log_id()  # read from the disk now, so that no stop waits for it
        self._heads = RecentKeys(1.0, HEADS_PER_S, displace=False)
        self._resumes = resumes
        self._robot = robot
        self._retry = EstopRetry(context, requester)
        self._unresumed: dict[str, float] = {}
        self._closings = Closings(
            f"mesh-{context.peer_id}-closing",
            lambda peer: requester.send(peer, {"action": "status"}, STATUS_S).get("result"),
        )
        self.late = LatePeers(context, adapter.epochs)
        self.stops: PeerStops | None = None
        self._admitted: deque[str] = deque(maxlen=RECENT_MAX)
        self._resumed: deque[str] = deque(maxlen=RECENT_MAX)
        self._over: deque[str] = deque(maxlen=RECENT_MAX)
        self.network = session.network().text
        self._latest = ""
        self._press = ("", 0.0)

    def locked(self) -> bool:
        return bool(self.adapter.epochs())

    def join(self) -> None:
        """Receive stops; a robot also on a connection of its own."""
        self.stops = PeerStops.joined_by(self)

    def leave(self) -> None:
        """Receive no more; nothing where this peer has not joined."""
        stops, self.stops = self.stops, None
        if stops is not None:
            stops.left_by(self)

    # Issuing.

    def emergency_stop(
        self,
        signing_key: Any = None,
        *,
        reason: str = "",
        estop_id: str = "",
        on_answers: OnAnswers = lambda replies: None,
        scope: Scope = EVERY_ROBOT,
        remembers: Remembers = none_known,
        on_widened: Callable[[], None] = lambda: None,
    ) -> list[dict[str, Any]]:
        """Stop this robot and every peer; return their replies, the local one first.

        Where no robot in ``scope`` is there, every robot is stopped.
        """
        context = self.context
        if not estop_id or estop_id != self._press[0]:
            self._press = (estop_id or new_epoch(), context.clock())
        epoch, pressed = self._press
        # Cut: a stop that its topic does not carry would reach nobody.
        reason = stated_reason({"reason": reason}) or NO_REASON
        order = StopOrder(epoch, context.peer_id, reason, "mesh", issued=context.clock(), pressed=pressed, scope=scope)
        if not scope.only:
            order = self._with_original(order, signing_key)
        if not scope.everything:
            return self._stop_some(order, signing_key, on_answers, remembers, on_widened)
        self._latest = order.epoch
        # The fleet receives the stop while the local robot halts.
        local = self.adapter.begin(order)
        none = {"responses_received": 0, "peers_not_stopped": 0, "peers_silent": 0}
        self._publish_estop(order, none, signing_key)
        self.late.overtaken()
        roster = {row["peer_id"] for row in context.registry.all() if row["reachable"]} - {context.peer_id}
        published = time.monotonic()

        def missing(replies: list[dict[str, Any]]) -> set[str]:
            nonlocal published
            on_answers(replies)
            absent = roster - {str(reply["responder_id"]) for reply in replies}
            if absent and time.monotonic() - published >= SPACING_S:
                # A link that was down when the stop was published may be back: the same stop again.
                published = time.monotonic()
                self._publish_estop(order, none, signing_key)
                self._open_link()
            return absent

        replies = self._requester.broadcast({"action": "stop"}, COLLECT_S, missing)
        verdict = local() if local is not None else None
        responses = [*self._local_reply(order, verdict), *replies]
        counts, stopped = self._conclude(order, responses, replies, roster)
        self._close_stop(order, counts, signing_key, {str(each["responder_id"]) for each in replies})
        unreached = (roster | context.registry.seen_within(KNOWN_S)) - stopped - {context.peer_id}
        if unreached:
            self._open_link()
        self._serve_missed()
        self._retry.begin(
            order.epoch,
            unreached,
            lambda: order.epoch in self.adapter.epochs(),
            lambda: self._publish_estop(order, counts, signing_key, paced=True),
        )
        return responses

    def _stop_some(
        self,
        order: StopOrder,
        signing_key: Any,
        on_answers: OnAnswers,
        remembers: Remembers,
        on_widened: Callable[[], None],
    ) -> list[dict[str, Any]]:
        """Stop the robots of the order's scope; return their replies, a local one first."""
        context, scope = self.context, order.scope
        local = self.adapter.begin(order)
        none = {"responses_received": 0, "peers_not_stopped": 0, "peers_silent": 0}
        body = self._estop_body(order, none, signing_key)
        stop = ScopedStop(
            context,
            self._requester,
            order.epoch,
            scope,
            body,
            lambda: self._publish_estop(order, none, signing_key),
            SPACING_S,
        )
        replies = stop.send(COLLECT_S, on_answers, remembers)
        if stop.widened:
            on_widened()
            return self.emergency_stop(signing_key, reason=order.reason, estop_id=order.epoch, on_answers=on_answers)
        own = self._local_reply(order, local() if local is not None else None) if self.adapter.within(scope) else []
        counts, stopped = self._conclude(order, [*own, *replies], replies, stop.targets())
        if scope.cell:
            self._close_stop(order, counts, signing_key, {str(each["responder_id"]) for each in replies})
        self._serve_missed()
        self._unresumed[order.epoch] = until = time.monotonic() + KNOWN_S
        while len(self._unresumed) > SCOPED_MAX:
            del self._unresumed[next(iter(self._unresumed))]
        self._retry.begin(
            order.epoch,
            stop.targets() - stopped,
            lambda: order.epoch in self._unresumed and time.monotonic() < until,
            stop.publish if scope.cell else lambda: None,
            stop.command,
        )
        return [*own, *replies]

    def _conclude(
        self, order: StopOrder, responses: list[dict[str, Any]], replies: list[dict[str, Any]], roster: set[str]
    ) -> tuple[dict[str, Any], set[str]]:
        """Log and audit the answers to a stop; return their counts, and who stopped."""
        context = self.context
        stopped = {str(each["responder_id"]) for each in responses if stop_outcome(each) is Outcome.STOPPED}
        not_stopped = [name for each in responses if (name := str(each["responder_id"])) not in stopped]
        silent = sorted(roster - {str(each["responder_id"]) for each in replies})
        for peer in not_stopped:
            logger.critical("%s did NOT stop on emergency stop %s.", peer, order.epoch)
        for peer in silent:
            logger.critical("%s did not answer emergency stop %s on the mesh.", peer, order.epoch)
        counts = {
            "responses_received": len(responses),
            "peers_not_stopped": len(not_stopped),
            "peers_silent": len(silent),
        }
        record_heads(context.peer_id, replies, roster)
        context.audit.always(
            "emergency_stop",
            estop_id=order.epoch,
            **counts,
            not_stopped=not_stopped,
            silent=silent,
            lockout_engaged=self.locked(),
            **order.scope.field(),
        )
        return counts, stopped

    def _close_stop(self, order: StopOrder, counts: dict[str, Any], signing_key: Any, answered: set[str]) -> None:
        """Publish the stop with its counts, later where a 0.5 peer would drop it."""
        older = self.context.registry.older()

        def publish() -> None:
            self._publish_estop(order, counts, signing_key, paced=bool(older))
            self._publish_event("emergency_stop", order.epoch)

        if older:
            self._closings.begin(publish, sorted(answered & {*older}))
        else:
            publish()

    def close(self, timeout: float) -> None:
        """Publish what is due before this peer leaves, within ``timeout`` seconds."""
        self._closings.close(timeout)

    def _local_reply(self, order: StopOrder, verdict: StopVerdict | None) -> list[dict[str, Any]]:
        """The reply of the local robot in a peer's form; none without a robot."""
        if not self._robot:
            return []
        context = self.context
        result = peer_stop_answer(verdict or StopVerdict(unknown={context.peer_id: "no answer"}))
        return [wire.Reply("response", context.peer_id, order.epoch, result, timestamp=context.clock()).to_wire()]

    def _publish_estop(
        self, order: StopOrder, counts: dict[str, Any], signing_key: Any, *, paced: bool = False
    ) -> None:
        context = self.context
        if paced and context.registry.older():
            with context.pacer.turn(SAFETY, SAFETY_S):
                # A peer of a 0.5 release would lock again by a stop that it was resumed from meanwhile.
                if order.epoch not in self._over:
                    self._put_estop(order, counts, signing_key)
        else:
            self._put_estop(order, counts, signing_key)
            context.pacer.note(SAFETY)

    def _with_original(self, order: StopOrder, signing_key: Any) -> StopOrder:
        """Return an order of ours with the message that robots which missed it are told."""
        payload = wire.encode(self._estop_body(order, {}, signing_key), topics.BY_NAME["estop"].max_bytes)
        return replace(order, original=payload, network=self.network)

    def _put_estop(self, order: StopOrder, counts: dict[str, Any], signing_key: Any) -> None:
        self._send_stop(order.epoch, self._estop_body(order, counts, signing_key))

    def _estop_body(self, order: StopOrder, counts: dict[str, Any], signing_key: Any) -> dict[str, Any]:
        # The time is that of the sending, because peers in the field refuse what is older than a minute.
        context = self.context
        head = {"peer_id": context.peer_id, "t": context.clock(), "estop_id": order.epoch}
        why = {} if order.reason == NO_REASON else {"reason": order.reason}
        times = {"lockout_engaged": True, **self._from_session(), "pressed_at": order.pressed}
        stated = {**head, **counts, **times, **why, **order.scope.field()}
        return self._signed(stated, Purpose.EMERGENCY_STOP, signing_key)

    # Receiving.

    def issued(self, epoch: str) -> None:
        """Note the latest stop of every robot; its resume clears the broker's copy."""
        self._latest = epoch

    def resumed_since(self, epoch: str) -> bool:
        """Return True for a stop that the broker stored with its resume."""
        return epoch in self._resumed

    def begun(self, order: StopOrder, fields: Mapping[str, Any], *, repeated: bool) -> None:
        """Note a stop of another peer whose halts are ordered; return at once."""
        context, epoch = self.context, order.epoch
        if repeated:
            self.late.repeated(epoch)
            if self.adapter.within(order.scope):
                context.audit("remote_estop_redundant", order.source, estop_id=epoch)
            return
        if order.timing(context.clock()) == "ahead":
            context.audit("estop_clock_skew", order.source, estop_id=epoch)
        if order.scope.everything:
            self.late.stopped(epoch, lambda: self._repeat_estop({**fields, "estop_id": epoch}))
        self._publish_event("emergency_stop", epoch)

    def on_own_estop(self, envelope: object, sample: Sample, sender: str, peer_id: str) -> str | None:
        """Lock by the envelope in a ``stop`` for this peer; return its epoch, or None.

        The plain stop is carried out whatever this says.

        Args:
            sender: of the command, who must be the envelope's issuer.
            peer_id: to whom the command was sent: this peer, or a robot of its world.
        """
        context, received, stops = self.context, time.monotonic(), self.stops
        if stops is None:
            return None
        body = dict(envelope) if isinstance(envelope, Mapping) else {}
        original = None
        with contextlib.suppress(wire.WireError):  # too long to be passed on
            original = wire.encode(body, topics.BY_NAME["estop"].max_bytes)
        stop = StopEvent(ESTOP, sample.session or "", original, received, stops.network.text, stops.codec)
        order = stops.codec.order(self.adapter.rules, stop, body, COMMANDED)
        if isinstance(order, StopOrder) and (order.source != sender or not is_epoch(body.get("estop_id"))):
            order = StopRefused(sender, "its issuer is not the sender, or it has no estop_id")
        if not isinstance(order, StopOrder):
            if order is not None:
                stops.refused(order)
            return None
        if peer_id in order.scope.only:
            # A robot of a world is locked with it.
            order = replace(order, scope=replace(order.scope, only=order.scope.only | {context.peer_id}))
        # Others that it names may have missed theirs.
        self.adapter.begin(replace(order, original=original, path="mesh"))
        return order.epoch

    def _repeat_estop(self, body: dict[str, Any]) -> None:
        """Publish a stop of another issuer again, from our session."""
        bare = {key: value for key, value in body.items() if key != "source_zid"}
        # A signature covers the time, so a signed stop keeps it.
        sent = {} if "sig" in bare else {"t": self.context.clock()}
        again = {**bare, **sent, **self._from_session()}
        self._send_stop(str(body["estop_id"]), again)

    def _send_stop(self, epoch: str, body: dict[str, Any]) -> None:
        """Publish a stop on both connections, as either may hang."""
        if self.stops is not None:
            self.stops.publish(topics.estop(), body)
        self._publish(topics.estop(), body, f"Emergency stop {epoch}", logging.CRITICAL)

    def _serve_missed(self) -> None:
        """Answer a robot that missed the stop and asks, also without a robot."""
        if self.stops is not None:
            with contextlib.suppress(TransportError):  # this peer has left the mesh
                self.stops.open(self)

    def _open_link(self) -> None:
        """Have a connection for stops, also without a robot; a first stop does not wait for that."""
        if self.stops is not None:
            with contextlib.suppress(TransportError):  # the next repetition or check-in tries again
                self.stops.connect(self)

    def _from_session(self) -> dict[str, str]:
        """Return the field that states our session, where the transport has any."""
        session = self.context.session_id()
        return {} if session is None else {"source_zid": session}

    def _publish_event(self, event: str, epoch: str) -> None:
        """Publish the redacted event for dashboards: its code, without the reason."""
        context = self.context
        body = {
            "peer_id": context.peer_id,
            "t": context.clock(),
            "event": event,
            "severity": "info",
            "reason": event,
            "estop_id": epoch,
        }
        self._publish(topics.safety_event(context.peer_id), body, "The safety event", logging.WARNING)

    def _publish(self, key: str, body: dict[str, Any], subject: str, level: int) -> None:
        try:
            self.context.put(key, body)
        except (TransportError, wire.WireError) as exc:
            logger.log(level, "%s was not published: %s", subject, exc)

    # Resume.

    def resume(self, signing_key: Any, targets: Sequence[str] | None) -> dict[str, Any]:
        """Sign for every epoch here and at the targets, and relay the assertions."""
        context, own = self.context, self.adapter.epochs()
        try:
            names = [identifier("target", name) for name in targets] if targets is not None else None
            wanted = (
                {row["peer_id"] for row in context.registry.all() if row["reachable"]} if names is None else {*names}
            )
            epochs = dict.fromkeys([*own, *self._reported(wanted)])
            if not epochs:
                return self._denied("no epoch is held")
            known = configured_keys()
            if known and ed25519.public_half(signing_key) not in known:
                return self._denied("no configured key is this one")
            late = wanted | (context.registry.seen_within(KNOWN_S) if names is None else set())
            signed = {
                each: sign(signing_key, each, wanted | ({context.peer_id} if each in own else set())) for each in epochs
            }
        except (ValidationError, AttributeError, TypeError) as exc:
            return self._denied(str(exc))
        relayed = 0
        for epoch, assertions in signed.items():
            self._unresumed.pop(epoch, None)
            for assertion in assertions:
                ours = epoch in own and context.peer_id in assertion["targets"]
                rejected = self.adapter.resume(assertion) if ours else None
                if rejected is not None:
                    return {"status": "error", "error": rejected}
                if relayed:
                    time.sleep(SPACING_S)
                self._over.append(epoch)
                with context.pacer.turn(SAFETY, SAFETY_S) if context.registry.older() else contextlib.nullcontext():
                    self._relay(assertion)
                relayed += 1
            self.late.renewable(epoch, late, lambda epoch, peers: self._relay_all(sign(signing_key, epoch, peers)))
        return {"status": "ok"}

    def _reported(self, peers: Iterable[str]) -> list[str]:
        """Ask peers that report lockouts for their epochs; return all of them."""
        registry = self.context.registry
        waited = {peer for peer in peers if "locked" in (registry.get(peer) or {})} - {self.context.peer_id}
        if not waited:
            return []

        def missing(replies: list[dict[str, Any]]) -> set[str]:
            return waited - {str(reply["responder_id"]) for reply in replies}

        replies = self._requester.broadcast({"action": "status"}, ASK_S, missing)
        results = [reply["result"] for reply in replies if reply["responder_id"] in waited and "result" in reply]
        held = [result.get("epochs") for result in results if isinstance(result, Mapping)]
        return [each for epochs in held if isinstance(epochs, list) for each in epochs if is_epoch(each)]

    def on_resume_command(self, assertion: object, peer_id: str = "") -> dict[str, Any]:
        """Admit and relay a resume that came as a command, or return the one rejection.

        Args:
            peer_id: the robot of this peer's world that was asked, if one was.
        """
        answer = self.adapter.answer_to_resume(assertion, peer_id)
        if answer["status"] == "ok":
            self._relay(assertion)
            self._note_admitted(assertion)
        return answer

    def on_resume(self, sample: Sample) -> None:
        """Receive a relayed resume; one meant for others is not counted as refused."""
        context = self.context
        try:
            body = wire.decode(sample.payload, topics.BY_NAME["resume"].max_bytes)
            relayer, assertion = wire.relay_of(body, sample.session)
        except wire.WireError as exc:
            context.audit("resume_denied", reason=str(exc))
            return
        if relayer == context.peer_id and sample.session == context.session_id():
            return
        if sample.retained:
            self._note_retained(assertion)
            return
        epochs = self.adapter.epochs()
        if not isinstance(assertion, dict) or not epochs or assertion.get("epoch") not in epochs:
            context.audit("remote_resume_redundant", relayer)
            if isinstance(assertion, dict):
                self.late.relayed(str(assertion.get("epoch")))
            return
        targets = assertion.get("targets")
        if not isinstance(targets, list) or context.peer_id not in targets:
            return
        try:
            self._resumes.submit(lambda: self._admit_relayed(relayer, assertion))
        except ShareFullError as exc:
            logger.warning("%s: a relayed resume was left out: %s", context.peer_id, exc)

    def _note_retained(self, assertion: Any) -> None:
        """Note the epoch of a retained resume, which ends its retained e-stop."""
        if not isinstance(assertion, dict):
            return
        signature = ed25519.decode(assertion.get("sig"), 64)
        try:
            covered = canonical_json({key: value for key, value in assertion.items() if key != "sig"})
        except (ValueError, TypeError, RecursionError):
            return
        if signature is not None and ed25519.signed_by_one_of(configured_keys(), signature, covered):
            self._resumed.append(str(assertion.get("epoch")))

    def _admit_relayed(self, relayer: str, assertion: Mapping[str, Any]) -> None:
        # The plane records a refusal with its reason; that it came twice is known here alone.
        nonce = str(assertion.get("nonce"))
        if self.adapter.resume(assertion) is None:
            self._admitted.append(nonce)
            self._note_admitted(assertion)
            self.context.audit.always("remote_resume_applied", about=relayer)
        elif nonce in self._admitted:
            self.context.audit("resume_replay_rejected", relayer)

    def _note_admitted(self, assertion: Any) -> None:
        """Pass an admitted resume on to targets that are back within its minute."""
        self._over.append(str(assertion["epoch"]))
        self.late.resumed(str(assertion["epoch"]), assertion["targets"], lambda: self._relay(assertion))

    def _relay_all(self, assertions: Iterable[Any]) -> None:
        for assertion in assertions:
            self._relay(assertion)

    def _relay(self, assertion: Any) -> None:
        context = self.context
        body = {"peer_id": context.peer_id, "t": context.clock(), "assertion": assertion, **self._from_session()}
        self._publish(topics.resume(), body, "A resume", logging.ERROR)
        transport = context.transport
        if transport is not None and isinstance(assertion, dict) and assertion.get("epoch") == self._latest:
            # A newcomer must not be locked by a stop that is over.
            with contextlib.suppress(TransportError):
                transport.clear_retained(topics.estop())

    # Check-in.

    def check_in(self, signing_key: Any = None) -> None:
        """Check in with the robots that need a live controller."""
        peer = self.context.peer_id
        body = self._signed({"peer_id": peer, "estop_id": new_epoch()}, Purpose.CHECK_IN, signing_key)
        self._open_link()
        if self.stops is None or not self.stops.publish(topics.check_in(peer), body):
            self._publish(topics.check_in(peer), body, "A check-in", logging.ERROR)

    def on_check_in(self, sample: Sample) -> None:
        """Record the check-in of a controller; a refused one is audited."""
        context = self.context
        stated = self._stated(sample, "checkin", "peer_id", topics.check_in)
        if stated is None:
            return
        source, body = stated
        why = self.adapter.check_in(source, body)
        if why is not None:
            context.audit("checkin_rejected", source, reason=why)
            return
        answer = self._answers.answer(context.peer_id, body.get("estop_id"), self.adapter.identity)
        if answer is not None:
            self._publish(topics.check_in_answer(context.peer_id), answer, "An answer to a check-in", logging.WARNING)

    def on_check_in_answer(self, sample: Sample) -> None:
        """Write down the head of a robot's audit, if this peer is its witness."""
        if not self._heads.first((sample.key, sample.payload)):
            return
        stated = self._stated(sample, "checkin_answer", "device_id", topics.check_in_answer)
        if stated is None:
            return
        source, body = stated
        # A robot reads no file here: its stops arrive on this thread.
        key = None if self._robot else (enrolled_peers() or {}).get(source)
        proof = proof_of(Purpose.CHECK_IN_ANSWER, source, body, key)
        if proof is not Proof.WRONG:
            self._witness.receive(source, body, by=self.context.peer_id, proven=proof is Proof.SIGNED)

    def _stated(
        self, sample: Sample, topic: str, name: str, key: Callable[[str], str]
    ) -> tuple[str, dict[str, Any]] | None:
        """Return the sender and the body; None, audited, if it is not its own."""
        context, rejected = self.context, f"{topic}_rejected"
        try:
            body = wire.decode(sample.payload, topics.BY_NAME[topic].max_bytes)
            source = identifier(name, body.get(name))
        except (wire.WireError, ValidationError) as exc:
            context.audit(rejected, reason=str(exc))
            return None
        bound = context.registry.session_of(source)
        if sample.retained:
            # A stored check-in says nothing of who is there now.
            context.audit(rejected, source, reason="the broker stored it")
            return None
        if sample.key != key(source) or (bound is not None and bound != sample.session):
            context.audit(rejected, source, reason="the topic or the session is another peer's")
            return None
        return source, body

    def _signed(self, fields: dict[str, Any], purpose: Purpose, signing_key: Any) -> dict[str, Any]:
        """Return the fields with the time; with a key also signed."""
        stated = {**fields, "t": self.context.clock()}
        if signing_key is None:
            return stated
        stated["nonce"] = secrets.token_hex(16)
        return signed_stop(signing_key, purpose, self.context.peer_id, stated)

    def _denied(self, why: str) -> dict[str, Any]:
        self.context.audit("resume_denied", reason=why)
        return {"status": "error", "error": REJECTED}
