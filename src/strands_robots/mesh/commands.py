"""Commands of other peers: wire form, checks of the sender, replies."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, Literal

from strands_robots.contract import Haltable, Robot, holds_robots
from strands_robots.envelope import Envelope, RefusalReason, Refused, error, is_error, jsonable
from strands_robots.mesh import topics, wire
from strands_robots.mesh.estop_retry import ESTOP
from strands_robots.mesh.former_actions import FORMER, as_verb, stops
from strands_robots.mesh.session import Context
from strands_robots.mesh.transport import Sample, TransportError
from strands_robots.mesh.wire_identity import MOTION, IdentityError
from strands_robots.rate_limits import RecentKeys
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.statements import with_stop_statement
from strands_robots.safety.stopping import Outcome, StopVerdict, explain, grade
from strands_robots.serving.peer_verbs import PEER_VERBS, peer_stop_answer, run_to_end
from strands_robots.serving.pipeline import Command, Own, Pipeline, Result, busy
from strands_robots.serving.stop_arguments import stop_of
from strands_robots.serving.stops import Request as StopRequest
from strands_robots.serving.stops import StopRequests, robot_stop, stop_within
from strands_robots.serving.verbs import OF_ALLOWED_CALLERS, Arguments, Kind, Verb
from strands_robots.serving.workers import ShareFullError
from strands_robots.stop_log import stop_logger
from strands_robots.utils import RESERVED_IDS, ValidationError, shown

logger = stop_logger(__name__)

MISSING_COMMAND = "missing or malformed command"
REPLAYED = "replay rejected"
LOCKED = "command rejected"
DISPATCH = "dispatch error"
BUSY = "busy"
RETAINED = "the broker stored it; a command is never retained"
PING = {"action": "ping"}
"""The command of a bare ping: nothing in it needs checking."""

HALT = "stop over the mesh"
LOG_EVERY_S = 1.0
REPLAY_S = wire.FRESH_S + wire.AHEAD_S
REPLAYS_MAX = 4096
LOCKING_MAX = 512
"""Stops with an envelope whose answer is still to come."""

PROVEN_MAX = 65_536
"""Signed commands that a peer tells apart in the time in which they are fresh; beyond that it refuses."""


TargetOf = Callable[[str], Haltable | None]
"""Gives what a stop means by a name, empty for all there is. Raises :class:`ValidationError` for an unknown name."""


class SenderCheck:
    """Check a sender: freshness, replays, and attribution for real hardware.

    Args:
        hardware: False for a simulation, which asks for no attribution.
    """

    def __init__(self, context: Context, *, hardware: bool) -> None:
        self._context = context
        self._hardware = hardware
        self._replays = RecentKeys(REPLAY_S, REPLAYS_MAX, context.monotonic)
        # Of its own, so that a flood of commands that prove nothing pushes no signed one out.
        self._proven = RecentKeys(REPLAY_S, PROVEN_MAX, context.monotonic, displace=False)

    def __call__(self, command: Command, arguments: Arguments) -> tuple[str, ...]:
        """Return the sender's proven names; raise :class:`Refused` where it may not."""
        request: wire.Request = command.proof
        asked = command.verb.kind in OF_ALLOWED_CALLERS
        if asked and request.sender_id in RESERVED_IDS:
            raise Refused(RefusalReason.CALLER, f"no peer is called {request.sender_id}")
        # What only takes energy away is done twice, and whatever the sender's clock says: refusing one as a replay
        # could only leave a robot moving.
        if asked or command.verb.kind is Kind.RESUME:
            if request.timestamp is None or not wire.fresh(request.timestamp, self._context.clock()):
                raise Refused(RefusalReason.CALLER, REPLAYED, reason="the timestamp is not fresh")
            # Commands of a stream have numbers of their own, and would push the turns of others out.
            if not command.verb.streamed and not self._replays.first((request.sender_id, request.turn_id)):
                raise Refused(RefusalReason.CALLER, REPLAYED, reason="the turn was carried out before")
        if not self._hardware or not asked:
            return ()
        try:
            return self._proven_names(request)
        except IdentityError as why:
            what = "moves real hardware" if command.verb.kind is Kind.MOTION else "is for known senders"
            besides = ", besides operator approval" if command.verb.kind is Kind.MOTION else ""
            text = (
                f"{command.verb.name} {what}, and its sender cannot be attributed: {why}. A console "
                f"on another machine is enrolled at this one{besides}."
            )
            raise Refused(RefusalReason.APPROVAL, text, reason=f"the sender is not attributed: {why}") from None

    def _proven_names(self, request: wire.Request) -> tuple[str, ...]:
        """Return the names that the sender's proof is good for.

        A certificate proves the peer id and its own name. A console's key proves no name: the one that its message
        bears counts where no certificates are in use. The session on a sample is no proof: its publisher chooses it.

        Raises:
            IdentityError: nothing proves the sender, or it is another's command, or one sent before.
        """
        context, sender, identity = self._context, request.sender_id, self._context.identity
        names: tuple[str, ...] = () if identity.checks else (sender,)
        certified = False
        if identity.checks or identity.required:
            try:
                names = (sender, identity.verify(request.body, sender).common_name)
                certified = True
            except IdentityError:
                if identity.required:
                    raise
        refusal = None if certified else context.consoles.refusal(request.body, MOTION)
        if refusal is not None:
            raise IdentityError(refusal)
        if request.body.get("target_id") not in (context.peer_id, wire.BROADCAST_TARGET):
            raise IdentityError("it was signed for another peer")
        if request.timestamp is None or context.predates(request.timestamp):
            raise IdentityError("it was issued before this peer started, by its sender's clock; send it again")
        if not self._proven.first((sender, request.turn_id)):
            raise IdentityError("it was carried out before, or too many signed commands came in a minute")
        return names


def stop_target(robot: Robot | None, name: str = "") -> Haltable | None:
    """Return the robot, or the named robot of a world, that a stop halts, or None.

    Raises:
        ValidationError: the world has no robot of this name.
    """
    return robot_stop(robot, name) if name and holds_robots(robot) else robot


def execute_on(robot: Robot, context: Context, closed: Callable[[], bool] = lambda: False) -> Own:
    """Make the ``execute`` of a peer: a policy runs to its end."""
    return lambda arguments, request: run_to_end(robot, arguments, lambda: closed() or not context.running(), request)


def pong(context: Context) -> dict[str, Any]:
    """Return the answer to a ping, with the ``pong`` that older peers look for."""
    return {"pong": True, "peer_id": context.peer_id, "t": context.clock()}


class CommandReceiver:
    """Receives commands for one peer and replies.

    Args:
        pipeline: serves everything but stops.
        target_of: finds what a stop means by a name; by default in the pipeline's robot.
        before_stop: called when a stop has arrived; it may wait for nothing.
        after_stop: called before stops are answered.
        robot_key: signs the answers to stops; without one they are not signed.
        lock: locks by the envelope of an emergency stop in a stop from this sender, and returns its epoch.
        epochs: returns those that lock the robot.
        own_verbs: those that the robot declares.
    """

    def __init__(
        self,
        context: Context,
        pipeline: Pipeline,
        *,
        target_of: TargetOf | None = None,
        before_stop: Callable[[], None] = lambda: None,
        after_stop: Callable[[], None] = lambda: None,
        robot_key: SigningIdentity | None = None,
        lock: Callable[[object, Sample, str], str | None] = lambda estop, sample, sender: None,
        epochs: Callable[[], Collection[str]] = tuple,
        own_verbs: Mapping[str, Verb] = MappingProxyType({}),
    ) -> None:
        self._context = context
        self._verbs = {**PEER_VERBS, **own_verbs}
        self._lock, self._epochs = lock, epochs
        self._locking: dict[str, str] = {}
        self._robot_key = robot_key
        self._pipeline = pipeline
        self._target_of = target_of or partial(stop_target, pipeline.robot)
        self._before_stop, self._after_stop = before_stop, after_stop
        self.stops = StopRequests(self._answer_stops)
        self._logged = ("", 0.0)
        self._retained_at = float("-inf")

    def on_command(self, sample: Sample) -> None:
        """Take a sample on our command topic or on the broadcast topic; returns at once."""
        context = self._context
        try:
            body = wire.decode(sample.payload, topics.BY_NAME["cmd"].max_bytes)
            if body.get("sender_id") == context.peer_id:
                return
            request = wire.Request.of(body)
        except wire.WireError as exc:
            context.audit("command_rejected", reason=str(exc))
            return
        if sample.retained and not _is_stop(request.command):
            self._refuse_retained(request, sample.key)
            return
        if request.command == PING:
            self._reply(request.sender_id, request.turn_id, result=pong(context))
            return
        action = request.command.get("action") if isinstance(request.command, dict) else None
        verb = self._verbs.get(action) if isinstance(action, str) else None
        if verb is None:
            verb = self._verb_of_former(request, action)
        if verb is None:
            return
        if verb.kind is Kind.STOP:
            self._lock_first(request, sample)
            self._stop(request, verb)
            return
        given = {name: value for name, value in request.command.items() if name != "action"}
        answered = partial(self._answer, request, verb)
        if verb.name == "ping":
            # It reaches nothing below the mesh, so it waits for no worker and no worker waits for it.
            self._pipeline.serve(Command(verb, given, request.sender_id, proof=request), answered)
            return
        arrived = self._pipeline.pending.arrive(request.command.get("robot_name"))
        command = Command(verb, given, request.sender_id, arrived, request)
        try:
            self._pipeline.shares.by_name[verb.share].submit(partial(self._pipeline.serve, command, answered))
        except ShareFullError:
            answered(busy(command))

    def _refuse_retained(self, request: wire.Request, key: str) -> None:
        """Refuse a command that a broker stored; no peer waits for its answer.

        It was meant for another moment. A stop is carried out all the same, because it only takes energy away.
        """
        action = request.command.get("action") if isinstance(request.command, dict) else None
        self._context.audit("command_refused", request.sender_id, action=str(action)[:32], reason=RETAINED)
        now = time.monotonic()
        if now - self._retained_at >= LOG_EVERY_S:
            self._retained_at = now
            name = self._context.peer_id
            logger.warning("%s: %s of %s on %s is refused: %s.", name, shown(action), request.sender_id, key, RETAINED)

    def _verb_of_former(self, request: wire.Request, action: object) -> Verb | None:
        """Return the verb that an action of a 0.5 release means, or refuse the command."""
        if not isinstance(action, str) or action not in FORMER:
            self._refuse_unknown(request, action)
            return None
        try:
            request.command = as_verb(request.command, self._verbs)
        except ValidationError as exc:
            self._reply(request.sender_id, request.turn_id, result=error(str(exc)))
            self._context.audit("command_refused", request.sender_id, action=action, reason=str(exc))
            return None
        return self._verbs[request.command["action"]]

    def _refuse_unknown(self, request: wire.Request, action: object) -> None:
        if not isinstance(request.command, dict):
            self._refuse(request, "", MISSING_COMMAND)
            return
        why = f"validation: action must be one of {', '.join(self._verbs)}, not {shown(action)}."
        self._refuse(request, action if isinstance(action, str) else "", why)

    def _answer(self, request: wire.Request, verb: Verb, answer: Result) -> None:
        refusal, audit = answer.refusal, self._context.audit
        if refusal is not None:
            event = "wire_motion_refused" if refusal.why is RefusalReason.APPROVAL else "command_refused"
            reason = DISPATCH if refusal.why is RefusalReason.FAILED else refusal.reason
            # The word of a lockout is the whole text on this wire; its facts go beside it.
            facts = refusal.envelope if refusal.why is RefusalReason.LOCKOUT else None
            self._refuse(request, verb.name, _wire_text(refusal), reason, event, facts)
            return
        self._reply(request.sender_id, request.turn_id, result=answer.result)
        if (verb.kind is not Kind.READ and not verb.streamed) or verb.name == "teleop_stop":
            event = "command_refused" if is_error(answer.result) else "command_executed"
            audit(event, request.sender_id, action=verb.name, turn_id=request.turn_id)

    def _lock_first(self, request: wire.Request, sample: Sample) -> None:
        """Lock where a stop holds the envelope of an emergency stop, and answer so."""
        estop = request.command.get(ESTOP)
        if estop is None:
            return
        try:
            epoch = self._lock(estop, sample, request.sender_id)
        except Exception:
            logger.critical("%s is stopped, and was not locked.", self._context.peer_id, exc_info=True)
            return
        if epoch is not None:
            self._locking[request.turn_id] = epoch
            while len(self._locking) > LOCKING_MAX:
                del self._locking[next(iter(self._locking))]

    def _stop(self, request: wire.Request, verb: Verb) -> None:
        name = verb.readable(request.command)[0]["robot_name"] or ""
        self._pipeline.pending.void(name)
        self._before_stop()
        try:
            target = self._target_of(name)
        except ValidationError as exc:
            result = peer_stop_answer(StopVerdict(not_stopped={name: str(exc)}))
            self._reply(request.sender_id, request.turn_id, result=result)
            fields = {"action": "stop", "turn_id": request.turn_id, "reason": explain(result)}
            self._context.audit("command_refused", request.sender_id, **fields)
            return
        except Exception:
            logger.exception("%s: what a stop means is not known; everything is stopped.", self._context.peer_id)
            target = stop_target(self._pipeline.robot)
        asker = (request.sender_id, request.turn_id)
        if target is None:
            self._answer_stops(StopVerdict(), [asker])
        else:
            self.stops.add(
                target,
                name or self._context.peer_id,
                stop_of(HALT, request.sender_id),
                asker,
                within=stop_within(target),
            )

    def _answer_stops(self, verdict: StopVerdict, requests: list[StopRequest]) -> None:
        self._after_stop()
        audit, result = self._context.audit, peer_stop_answer(verdict)
        event, fields = "command_executed", {"action": "stop"}
        if grade(result) is not Outcome.STOPPED:
            event, fields["reason"] = "command_refused", explain(result)
            self._log_doubt(fields["reason"])
        for sender, turn in requests:
            epoch = self._locking.pop(turn, None)
            lock = {} if epoch is None else {"estop_id": epoch, "locked": epoch in self._epochs()}
            signed = with_stop_statement(self._robot_key, self._context.peer_id, turn, result)
            self._reply(sender, turn, result={**signed, **lock})
            audit(event, sender, turn_id=turn, **fields)

    def _log_doubt(self, reason: str) -> None:
        # A flood of stops to a robot that does not stop is one line a second.
        now = time.monotonic()
        if reason != self._logged[0] or now - self._logged[1] >= LOG_EVERY_S:
            self._logged = (reason, now)
            logger.critical("%s was asked to stop over the mesh: %s.", self._context.peer_id, reason)

    def _refuse(  # noqa: PLR0917 - one refusal
        self,
        request: wire.Request,
        action: str,
        text: str,
        reason: str = "",
        event: str = "command_refused",
        envelope: Envelope | None = None,
    ) -> None:
        self._context.audit(event, request.sender_id, action=action[:32], reason=reason or text)
        self._reply(request.sender_id, request.turn_id, error=text, refusal=envelope)

    def _reply(
        self,
        sender: str,
        turn: str,
        *,
        result: Any = None,
        error: str = "",
        refusal: Envelope | None = None,
        plain: bool = False,
    ) -> None:
        context = self._context
        if sender in RESERVED_IDS:
            return  # a reply below the safety topics would make 0.5.3 peers drop e-stops
        kind: Literal["response", "error"] = "error" if error else "response"
        reply = wire.Reply(kind, context.peer_id, turn, result, error, context.clock(), refusal=refusal)
        key = topics.response(sender, context.peer_id, turn)
        try:
            context.put(key, context.identity.sign(reply.to_wire()))
        except TransportError as exc:
            logger.warning("%s: the reply to %s was not sent: %s", context.peer_id, sender, exc)
        except (TypeError, ValueError, RecursionError) as exc:
            if not plain and not isinstance(exc, wire.TooLargeError):
                # Something in it is no JSON, which costs that value alone: what the robot did has begun.
                self._reply(sender, turn, result=jsonable(result), error=error, refusal=jsonable(refusal), plain=True)
                return
            logger.warning("%s: the reply to %s cannot be sent: %s", context.peer_id, sender, exc)
            if not error:
                self._reply(sender, turn, error=DISPATCH)


def _is_stop(command: object) -> bool:
    action = command.get("action") if isinstance(command, dict) else None
    verb = PEER_VERBS.get(action) if isinstance(action, str) else None
    return verb.kind is Kind.STOP if verb is not None else isinstance(command, dict) and stops(command)


def _wire_text(refusal: Refused) -> str:
    """Return the words that peers in the field know a refusal by."""
    if refusal.why is RefusalReason.ARGUMENTS:
        return f"validation: {refusal}"
    known = {RefusalReason.LOCKOUT: LOCKED, RefusalReason.BUSY: BUSY, RefusalReason.FAILED: DISPATCH}
    return known.get(refusal.why, str(refusal))
