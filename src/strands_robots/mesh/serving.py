"""Answering other peers: what a command passes before it reaches the robot, and the reply."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

from strands_robots.envelope import is_error
from strands_robots.mesh import topics, wire
from strands_robots.mesh.context import Context
from strands_robots.mesh.executor import Lane, Lanes
from strands_robots.mesh.registry import attribute
from strands_robots.mesh.security import ANSWERED_WHILE_LOCKED, CHANGING, MOTION, STOP_FIELDS, validate_command
from strands_robots.mesh.stops import Asker, Stops, Tell
from strands_robots.mesh.transport import Sample, TransportError
from strands_robots.safety.approval import Approval, Claim
from strands_robots.safety.gate import Asked, MotionGate
from strands_robots.safety.stopping import Outcome, explain, grade
from strands_robots.utils import ValidationError

logger = logging.getLogger(__name__)

MISSING_COMMAND = "missing or malformed command"
REPLAYED = "replay rejected"
LOCKED = "command rejected"
DISPATCH = "dispatch error"
BUSY = "busy"
PING = {"action": "ping"}
"""The command of a bare ping: nothing in it needs checking, and its answer is nothing."""

REPLAY_S = wire.FRESH_S + wire.AHEAD_S
REPLAYS_MAX = 4096

Dispatch = Callable[[dict[str, Any]], Any]

Meant = Callable[[str], str | dict[str, Any]]
"""The robot that a stop means by a name, empty for all there is; or the answer, where there is none of that name."""


class Refused(Exception):  # noqa: N818 - a refusal, not a fault
    """A command that is answered with an error; ``event`` is its audit record."""

    def __init__(self, text: str, event: str = "command_refused", reason: str = "") -> None:
        super().__init__(text)
        self.event = event
        self.reason = reason or text


class Replays:
    """Which (sender, turn) were carried out lately; bounded by age and number."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._seen: dict[tuple[str, str], float] = {}
        self._lock = threading.Lock()

    def first(self, sender: str, turn: str) -> bool:
        now = self._clock()
        with self._lock:
            while self._seen and now - next(iter(self._seen.values())) > REPLAY_S:
                del self._seen[next(iter(self._seen))]
            if (sender, turn) in self._seen:
                return False
            while len(self._seen) >= REPLAYS_MAX:
                del self._seen[next(iter(self._seen))]
            self._seen[sender, turn] = now
            return True


class MotionDoor:
    """Who may move metal over the wire: the sender whose session is proven, with the operator's approval.

    Args:
        hardware: False for a simulation, which is exempt.
    """

    def __init__(self, context: Context, *, hardware: bool, approval: Approval | None = None) -> None:
        self._context = context
        self._approval = approval or Approval()
        self.hardware = hardware

    def claim(self, action: str, request: wire.Request, sample: Sample) -> Claim:
        """Leave to do ``action``. Raises Refused; a one-shot grant is spent only by a sender that is proven."""
        if not self.hardware or action not in MOTION:
            return Claim()
        why = self._unattributed(request, sample)
        if why is None:
            claim = self._approval.claim(action, self._context.peer_id)
            if claim is not None:
                return claim
            why = "the operator has not approved it"
        refusal = self._approval.refusal(action, self._context.peer_id)
        raise Refused(refusal, "wire_motion_refused", why)

    def _unattributed(self, request: wire.Request, sample: Sample) -> str | None:
        context = self._context
        if context.identity.required:
            return context.identity.refusal(request.body, request.sender_id)
        found = attribute(context.registry.session_of(request.sender_id), sample)
        return None if found.proven else f"the sender is not attributed: {found.value}"


class Line:
    """Commands that have arrived and are not carried out yet, each as old as its arrival.

    A halt since then refuses what one of them begins, and so does the stop of the robot that it names.

    Args:
        gate: of the peer's robot; None for a peer without one.
    """

    def __init__(self, gate: MotionGate | None) -> None:
        self._gate = gate
        self._robot = ""
        self._lock = threading.Lock()
        self._standing: WeakKeyDictionary[Asked, str] = WeakKeyDictionary()

    def of(self, robot: str) -> Line:
        """The same line, for the peer of one robot of a world: whatever comes there means this one."""
        line = Line(self._gate)
        line._robot, line._lock, line._standing = robot, self._lock, self._standing
        return line

    def join(self, command: object) -> AbstractContextManager[None]:
        """Taken when a command arrives; entered on the thread and at the time that carries it out."""
        if self._gate is None:
            return nullcontext()
        asked = self._gate.asked()
        with self._lock:
            self._standing[asked] = self._robot or _robot(command)
        return self._gate.asked_at(asked)

    def stopped(self, command: object) -> None:
        """A stop that names one robot has arrived; what came before it for this robot, or for any, is void."""
        name = _robot(command) or self._robot
        with self._lock:
            for asked, whose in self._standing.items() if name else ():
                if whose in (name, ""):
                    asked.give_up()


def _robot(command: object) -> str:
    name = command.get("robot_name") if isinstance(command, dict) else None
    return name if isinstance(name, str) else ""


class Server:
    """Receives commands for one peer and replies.

    Args:
        locked: whether the lockout holds this peer.
        dispatch: carries out a validated command and returns its result.
        line: where a command stands until its turn comes, so that a stop in between refuses it.
        meant: what a stop means by a name; by default all there is.
    """

    def __init__(
        self,
        context: Context,
        lanes: Lanes,
        door: MotionDoor,
        locked: Callable[[], bool],
        dispatch: Dispatch,
        *,
        line: Line | None = None,
        meant: Meant = lambda name: "",
    ) -> None:
        self._context = context
        self._lanes = lanes
        self._door = door
        self._locked = locked
        self._dispatch = dispatch
        self._line = line or Line(None)
        self._replays = Replays(context.monotonic)
        self._meant = meant
        self._stops = Stops(lanes.stop_lane, lanes.answers, self._halt)

    def on_command(self, sample: Sample) -> None:
        """A sample on our command topic or on the broadcast topic; returns at once."""
        context = self._context
        try:
            body = wire.decode(sample.payload, topics.BY_NAME["cmd"].max_bytes)
            if body.get("sender_id") == context.peer_id:
                return
            request = wire.Request.of(body)
        except wire.WireError as exc:
            context.audit("command_rejected", reason=str(exc))
            return
        if request.command == PING:
            self._reply(request, result={})
            return
        action = request.command.get("action") if isinstance(request.command, dict) else None
        if action == "ping":
            # It reaches nothing below the mesh, so it waits for no worker and no worker waits for it.
            self._serve(request, sample)
            return
        if action == "stop":
            self._line.stopped(request.command)
            self._take_stop(request, sample)
            return
        asked = self._line.join(request.command)

        def serve() -> None:
            with asked:
                self._serve(request, sample)

        if not self._lane_of(action).submit(serve):
            context.audit("command_refused", request.sender_id, reason=BUSY)
            self._reply(request, error=BUSY)

    def _lane_of(self, action: object) -> Lane:
        """A motion may hold its worker while it lasts; what reads, resumes or ends one never waits for that."""
        if action == "resume":
            return self._lanes.resumes
        return self._lanes.commands if action in MOTION else self._lanes.quick

    def _take_stop(self, request: wire.Request, sample: Sample) -> None:
        try:
            command, _ = self._admit(request, sample)
        except Refused as refused:
            self._refuse(request, refused)
            return
        audit, asker = self._context.audit, (request.sender_id, request.turn_id)
        try:
            robot = self._meant(command.get("robot_name", ""))
        except Exception:
            logger.exception("%s: who is meant by a stop is not known; everything is stopped.", self._context.peer_id)
            robot = ""
        if isinstance(robot, dict):
            self._reply(request, result=robot)
            audit("command_refused", asker[0], action="stop", turn_id=asker[1], reason=explain(robot))
        elif not self._stops.add(robot, *asker):
            audit("command_refused", asker[0], action="stop", reason=BUSY)
            self._reply(request, error=BUSY)

    def _halt(self, robot: str) -> Tell:
        result, failed = None, ""
        try:
            result = self._dispatch({"action": "stop", **({"robot_name": robot} if robot else {})})
        except Exception:
            logger.exception("%s: a stop failed.", self._context.peer_id)
            failed = DISPATCH
        return partial(self._tell, result, failed)

    def _tell(self, result: Any, failed: str, askers: list[Asker]) -> None:
        audit, event, fields = self._context.audit, "command_executed", {"action": "stop"}
        if failed or grade(result) is not Outcome.STOPPED:
            event, fields["reason"] = "command_refused", failed or explain(result)
            logger.critical("%s was asked to stop over the mesh: %s.", self._context.peer_id, fields["reason"])
        for sender, turn in askers:
            self._answer(sender, turn, result=result, error=failed)
            audit(event, sender, turn_id=turn, **fields)
        if not askers:
            audit(event, **fields)

    def _serve(self, request: wire.Request, sample: Sample) -> None:
        audit = self._context.audit
        try:
            command, claim = self._admit(request, sample)
        except Refused as refused:
            self._refuse(request, refused)
            return
        action = command["action"]
        try:
            result = self._dispatch(command)
        except Exception:
            logger.exception("%s: %s of %s failed.", self._context.peer_id, action, request.sender_id)
            claim.give_back()
            audit("command_refused", request.sender_id, action=action, reason=DISPATCH)
            self._reply(request, error=DISPATCH)
            return
        if is_error(result):
            claim.give_back()
        else:
            claim.spend()
        self._reply(request, result=result)
        if action in CHANGING:
            event = "command_refused" if is_error(result) else "command_executed"
            audit(event, request.sender_id, action=action, turn_id=request.turn_id)

    def _admit(self, request: wire.Request, sample: Sample) -> tuple[dict[str, Any], Claim]:
        if not isinstance(request.command, dict):
            raise Refused(MISSING_COMMAND)
        try:
            command = validate_command(request.command, providers=self._context.providers)
        except ValidationError as exc:
            raise Refused(f"validation: {exc}") from None
        action = command["action"]
        if action not in ANSWERED_WHILE_LOCKED and self._locked():
            raise Refused(LOCKED, reason="locked by an emergency stop")
        # What only takes energy away is done twice, and whatever the sender's clock says: refusing one as a replay
        # could only leave a robot moving.
        if action in CHANGING and action not in STOP_FIELDS:
            if request.timestamp is None or not wire.fresh(request.timestamp, self._context.clock()):
                raise Refused(REPLAYED, reason="the timestamp is not fresh")
            if not self._replays.first(request.sender_id, request.turn_id):
                raise Refused(REPLAYED, reason="the turn was carried out before")
        return command, self._door.claim(action, request, sample)

    def _refuse(self, request: wire.Request, refused: Refused) -> None:
        named = request.command.get("action") if isinstance(request.command, dict) else None
        action = named if isinstance(named, str) else ""
        self._context.audit(refused.event, request.sender_id, action=action[:32], reason=refused.reason)
        self._reply(request, error=str(refused))

    def _reply(self, request: wire.Request, *, result: Any = None, error: str = "") -> None:
        self._answer(request.sender_id, request.turn_id, result=result, error=error)

    def _answer(self, sender: str, turn: str, *, result: Any = None, error: str = "") -> None:
        context = self._context
        reply = wire.Reply("error" if error else "response", context.peer_id, turn, result, error, context.clock())
        key = topics.response(sender, context.peer_id, turn)
        try:
            context.put(key, context.identity.sign(reply.to_wire()))
        except wire.WireError as exc:
            logger.warning("%s: the reply to %s cannot be sent: %s", context.peer_id, sender, exc)
            if not error:
                self._answer(sender, turn, error=DISPATCH)
        except TransportError as exc:
            logger.warning("%s: the reply to %s was not sent: %s", context.peer_id, sender, exc)
