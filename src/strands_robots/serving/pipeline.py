"""Pipeline of a command from any network to a robot's method.

In order: the arguments, leave to begin (:mod:`~strands_robots.serving.leave`), the robot's method. The first that
refuses raises :class:`~strands_robots.serving.leave.Refused`, which says which it was. Whatever is raised on the way
becomes a :class:`Result` here alone. Stops take no part in it: they go to the stop executor at once, for every caller.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from strands_robots.contract import Robot, body_of
from strands_robots.envelope import Envelope, error, is_error
from strands_robots.identity_map import IdentityMap
from strands_robots.safety.authorization import Leave
from strands_robots.safety.gate import REFUSALS, MotionGate, MotionRefused, MotionRequest, refusal_envelope
from strands_robots.serving.control import NotHolderError, leases_of
from strands_robots.serving.leave import Command, MotionRules
from strands_robots.serving.offered_verbs import tasks_refused
from strands_robots.serving.refused import RefusalReason, Refused
from strands_robots.serving.verbs import Arguments, Kind, Verb
from strands_robots.serving.workers import Share, Shares, shares_of
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError

logger = stop_logger(__name__)


def _own_refusal(verb: str, refused: Exception) -> Envelope:
    """Return the answer to a verb that refused by itself."""
    envelope = refusal_envelope(verb, refused)
    if isinstance(refused, ValidationError):
        return RefusalReason.ARGUMENTS.noted(envelope)
    return RefusalReason.LOCKOUT.noted(envelope) if envelope.get("locked") is True else envelope


@dataclass(frozen=True)
class Result:
    """Result of a command: the robot's answer, or a refusal."""

    result: Any
    refusal: Refused | None = None


def busy(command: Command) -> Result:
    """Return the answer to a command for which no thread of the robot is left."""
    text = f"{command.verb.name} refused: the robot has not yet answered earlier calls; try again later."
    refused = Refused(RefusalReason.BUSY, text, reason="busy")
    return Result(refused.envelope, refused)


Answered = Callable[[Result], None]
"""Gets a command's answer on the thread that served it; it may not raise."""

Own = Callable[[Arguments, MotionRequest | None], object]
"""Carries out a verb that is the network peer's own and not its robot's, for the command's request."""


class PendingCommands:
    """Commands that have arrived and not been carried out.

    A halt since then refuses what one of them begins; so does the stop of the one robot of a world that it names.

    Args:
        gate: of the robot; None for a peer without one.
        robot: the robot of the world that every command here means; empty where commands name it.
    """

    def __init__(self, gate: MotionGate | None, robot: str = "", shared: PendingCommands | None = None) -> None:
        self._gate = gate
        self._robot = robot
        self._lock: threading.Lock = shared._lock if shared else threading.Lock()
        self._pending: WeakKeyDictionary[MotionRequest, str] = shared._pending if shared else WeakKeyDictionary()

    def of(self, robot: str) -> PendingCommands:
        """The same commands, for the peer of one robot of the world."""
        return PendingCommands(self._gate, robot, self)

    def arrive(self, robot: str = "") -> MotionRequest | None:
        """Note a command's arrival; what it begins may be no older than this."""
        if self._gate is None:
            return None
        request = self._gate.request()
        with self._lock:
            self._pending[request] = self._robot or robot
        return request

    def void(self, robot: str = "") -> None:
        """Void pending commands of this robot of the world, because it is stopped."""
        name = robot or self._robot
        with self._lock:
            for request, named in self._pending.items() if name else ():
                if named in (name, ""):
                    request.give_up()


_PENDING: IdentityMap[PendingCommands] = IdentityMap()


@dataclass
class Pipeline(MotionRules):
    """Serves the commands of one robot on one network, by its rules.

    Attributes:
        own: verbs that the peer carries out itself, by name.
        pending: commands that a stop has to reach before they begin.
        shares: the robot's threads.
    """

    own: Mapping[str, Own] = field(default_factory=dict)
    pending: PendingCommands = field(default_factory=lambda: PendingCommands(None))
    shares: Shares = field(default_factory=Shares)
    _serving: list[str] = field(default_factory=list, init=False)
    _closed: bool = field(default=False, init=False)
    _changed: threading.Condition = field(default_factory=threading.Condition, init=False, repr=False)

    @classmethod
    def of(cls, robot: Robot | None, peer_id: Callable[[], str], **parts: Any) -> Pipeline:
        """Make the pipeline of a robot, with shares and pending commands of its own."""
        gate = None if robot is None else robot.gate
        # The same on every network: a stop of one robot of a world voids what waits on the others.
        pending = PendingCommands(None) if robot is None else _PENDING.of(body_of(robot), lambda: PendingCommands(gate))
        parts.setdefault("pending", pending)
        parts.setdefault("shares", Shares() if robot is None else shares_of(robot))
        parts.setdefault("leases", None if robot is None else leases_of(robot, hardware=parts["hardware"]))
        return cls(robot, peer_id, **parts)

    def share(self, verb: Verb) -> Share:
        """Return the share of threads for a verb; only motions wait for motions."""
        if verb.urgent:
            return self.shares.urgent
        if verb.lasts and not (verb.own and verb.kind is Kind.READ):
            return self.shares.lasting
        if verb.kind is Kind.MOTION:
            return self.shares.motion
        return self.shares.own_read if verb.own else self.shares.read

    def serve(self, command: Command, answered: Answered) -> None:
        """Carry ``command`` out on this thread and hand its answer to ``answered``."""
        verb, leave = command.verb, Leave()
        result: object = None
        refusal: Refused | None = None
        begun = False
        with self._changed:
            self._serving.append(verb.name)
        try:
            arguments = self._checked(command)
            leave = self.leave(command, arguments)
            # Of what ends in an exception nobody knows whether it moves.
            begun = True
            if verb.name in self.own:
                result = self.own[verb.name](arguments, command.request)
            elif self.robot is None:
                result = error(f"{verb.name}: no robot is registered on this peer.")
            else:
                result = verb.call(self.robot, arguments, command.request)()
            begun = not is_error(result)
        except Refused as refused:
            refusal, result, begun = refused, refused.envelope, False
        except NotHolderError as exc:
            result, begun = RefusalReason.CONTROL.noted(exc.envelope), False
        except REFUSALS as exc:
            result, begun = _own_refusal(verb.name, exc), False
        except BaseException:
            # A binding's panic is no Exception; the caller is answered all the same, and the thread goes on.
            logger.exception("%s: %s failed.", self.peer_id(), verb.name)
            refusal = Refused(RefusalReason.FAILED, f"{verb.name} failed inside the device; its log has the details.")
            result = refusal.envelope
        try:
            try:
                # A motion that began and ended badly is answered with an error, too.
                leave.settle(begun or command.begun)
            except OSError:
                logger.exception("%s: the grant of %s is still in its folder.", self.peer_id(), verb.name)
            answered(Result(result, refusal))
        finally:
            with self._changed:
                self._serving.remove(verb.name)
                self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """True once the peer leaves its network."""
        return self._closed

    def close(self, timeout: float = 0.0) -> list[str]:
        """Refuse waiting commands and wait; return the verbs still running."""
        self._closed = True
        with self._changed:
            self._changed.wait_for(lambda: not self._serving, timeout)
            return list(self._serving)

    def _checked(self, command: Command) -> dict[str, Any]:
        if self._closed:
            raise Refused(
                RefusalReason.BUSY, f"{command.verb.name} refused: this peer has left its network.", reason="closed"
            )
        try:
            return command.verb.checked(command.arguments)
        except ValidationError as exc:
            lacking = None if self.robot is None else tasks_refused(self.robot, command.verb, self.peer_id())
            if lacking is not None:
                raise MotionRefused(error(lacking)) from None
            raise Refused(RefusalReason.ARGUMENTS, str(exc)) from None
