"""Pipeline of a command from any network to a robot's method.

In order: the arguments, leave to begin, the robot's method. The first that refuses raises
:class:`~strands_robots.envelope.Refused`, which says which it was. Whatever is raised on the way becomes a
:class:`Result` here alone. Stops take no part in it: they go to the stop executor at once, for every caller.

Leave to begin is one question: caller, control lease, lockout, the operator's approval. A call that is refused must not
keep others from moving, so the robot is held, and a grant claimed, when nothing has refused; :meth:`Leave.settle` gives
both back where the robot then starts nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

from strands_robots import settings
from strands_robots.contract import Robot, body_of
from strands_robots.envelope import Envelope, RefusalReason, Refused, error, is_error
from strands_robots.safety.authorization import Approval, Leave, digest
from strands_robots.safety.gate import REFUSALS, MotionGate, MotionRefused, MotionRequest, refusal_envelope
from strands_robots.serving.control import NotHolderError
from strands_robots.serving.control_leases import ControlLeases, leases_of
from strands_robots.serving.offered_verbs import tasks_refused, unoffered
from strands_robots.serving.policy_arguments import MOCK, MOCK_REFUSED
from strands_robots.serving.verbs import LEASE_ID, LEASE_NAMES, LEASE_TTL_S, Arguments, Kind, Verb
from strands_robots.serving.workers import Shares, shares_of
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap, ValidationError

logger = stop_logger(__name__)


@dataclass(frozen=True)
class Command:
    """One call of a verb, as a network received it.

    Attributes:
        arguments: unchecked, as the caller gave them.
        caller: the caller's declared name, or whatever stood in its place.
        request: of a motion, made of the robot's gate when the command arrived; None for a peer without a robot.
        proof: what the network knows of the sender besides its name.
    """

    verb: Verb
    arguments: Mapping[str, Any]
    caller: object = None
    request: MotionRequest | None = None
    proof: Any = None

    @property
    def begun(self) -> bool:
        """True once something has moved by it, whatever it is answered."""
        return self.request is not None and self.request.begun


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


Authorize = Callable[[Command, Arguments], Collection[str] | None]
"""Raises :class:`Refused` where the caller may not; :mod:`strands_robots.safety.authorization` decides.

Returns the names by which an approval may know the caller, None without any.
"""

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

    def arrive(self, robot: object = "") -> MotionRequest | None:
        """Note a command's arrival; what it begins may be no older than this.

        Args:
            robot: the robot of a world that it names; anything but a text names none.
        """
        if self._gate is None:
            return None
        request = MotionRequest(self._gate)
        with self._lock:
            self._pending[request] = self._robot or (robot if isinstance(robot, str) else "")
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
class Pipeline:
    """Serves the commands of one robot on one network, by its rules.

    Attributes:
        robot: behind its contract; None for a peer that only watches and commands.
        peer_id: gives the name that the operator's approval is for.
        hardware: True where a motion needs the operator's approval besides the caller's authorization.
        authorize: the network's question to the caller.
        approval: the operator's.
        leases: who holds the robot, on every network.
        own: verbs that the peer carries out itself, by name.
        pending: commands that a stop has to reach before they begin.
        shares: the robot's threads.
    """

    robot: Robot | None
    peer_id: Callable[[], str]
    hardware: bool
    authorize: Authorize
    approval: Approval = field(default_factory=Approval)
    leases: ControlLeases | None = None
    own: Mapping[str, Own] = field(default_factory=dict)
    pending: PendingCommands = field(default_factory=lambda: PendingCommands(None))
    shares: Shares = field(default_factory=Shares)
    closed: bool = field(default=False, init=False)
    """True once the peer leaves its network."""
    _serving: list[str] = field(default_factory=list, init=False)
    _changed: threading.Condition = field(default_factory=threading.Condition, init=False, repr=False)

    @classmethod
    def of(cls, robot: Robot | None, peer_id: Callable[[], str], **parts: Any) -> Pipeline:
        """Make the pipeline of a robot, whose leases and threads all networks share."""
        if robot is not None:
            gate = robot.gate
            # The same on every network: a stop of one robot of a world voids what waits on the others.
            parts.setdefault("pending", _PENDING.of(body_of(robot), lambda: PendingCommands(gate)))
            parts.setdefault("shares", shares_of(robot))
            if "leases" not in parts:
                parts["leases"] = leases_of(robot, hardware=parts["hardware"])
        return cls(robot, peer_id, **parts)

    def serve(self, command: Command, answered: Answered) -> None:
        """Carry ``command`` out on this thread and hand its answer to ``answered``."""
        verb = command.verb
        arguments: dict[str, Any] | None = None
        leave: Leave | None = None
        result: object = None
        refusal: Refused | None = None
        begun = False
        with self._changed:
            self._serving.append(verb.name)
        try:
            arguments = verb.checked(command.arguments)
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
            if leave is None:
                refusal = Refused(RefusalReason.CONTROL, str(exc), envelope=exc.envelope)
        except REFUSALS as exc:
            begun = False
            result, refusal = self._refusal_of(verb, exc, checked=arguments is not None)
        except BaseException:
            # A binding's panic is no Exception; the caller is answered all the same, and the thread goes on.
            logger.exception("%s: %s failed.", self.peer_id(), verb.name)
            refusal = Refused(RefusalReason.FAILED, f"{verb.name} failed inside the device; its log has the details.")
            result = refusal.envelope
        try:
            try:
                # A motion that began and ended badly is answered with an error, too.
                if leave is not None:
                    leave.settle(begun or command.begun)
            except OSError:
                logger.exception("%s: the grant of %s is still in its folder.", self.peer_id(), verb.name)
            answered(Result(result, refusal))
        finally:
            with self._changed:
                self._serving.remove(verb.name)
                self._changed.notify_all()

    def close(self, timeout: float = 0.0) -> list[str]:
        """Refuse waiting commands and wait; return the verbs still running."""
        self.closed = True
        with self._changed:
            self._changed.wait_for(lambda: not self._serving, timeout)
            return list(self._serving)

    def leave(self, command: Command, arguments: dict[str, Any]) -> Leave:
        """Return leave to begin; a read needs no more than its caller's authorization.

        Args:
            command: as it was received.
            arguments: checked. Those of the lease are taken out; a verb on the lease gets its parts.

        Raises:
            Refused: naming who refused, and why.
            MotionRefused: the robot does not offer the verb, or was halted since the command arrived.
        """
        verb = command.verb
        if self.closed:
            text = f"{verb.name} refused: this peer has left its network."
            raise Refused(RefusalReason.BUSY, text, reason="closed")
        try:
            callers = self.authorize(command, arguments) or ()
        except Refused:
            self._refuse_unoffered(verb)
            raise
        if verb.on_lease:
            self._give_leases(command, arguments)
        admit: Callable[..., Leave] | None = None
        if verb.leased and not verb.on_lease:
            lease_id, ttl_s = arguments.pop(LEASE_ID, "") or "", arguments.pop(LEASE_TTL_S, 0.0) or 0.0
            if ttl_s and not lease_id:
                needs = f"{LEASE_TTL_S} needs a {LEASE_ID}: a secret of the caller's own."
                raise Refused(RefusalReason.ARGUMENTS, needs)
            name = None if verb.of_world else arguments.get("robot_name", "")
            if self.leases is not None:
                asked = verb.name, command.caller, lease_id, name, ttl_s
                admit = partial(self.leases.admit, *asked, begun=lambda: command.begun)
        if verb.kind is not Kind.MOTION:
            return Leave()
        if admit is not None:
            admit(hold=False)
        self._refuse_locked(verb, command.request)
        wanted = self._unclaimed(command, arguments, callers) if self.hardware else None
        held = Leave() if admit is None else admit(hold=True)
        if wanted is None:
            return held
        claimed = None
        try:
            claimed = self.approval.claim(*wanted)
        finally:
            if claimed is None:
                held.settle(begun=False)
        if claimed is None:
            raise self._unapproved(verb)
        return Leave(held.settle, claimed.settle)

    def _unclaimed(
        self, command: Command, arguments: Arguments, callers: Collection[str]
    ) -> tuple[str, str, Collection[str], str] | None:
        """Return the grant that a motion has to claim; None where it needs none.

        Raises:
            Refused: no grant is for it.
        """
        verb, peer = command.verb, self.peer_id()
        mock = arguments.get("policy_provider") == MOCK and getattr(self.robot, "runs_policies", False)
        if mock and not settings.boolean("STRANDS_ALLOW_MOCK"):
            text = f"{verb.name} is refused: {MOCK_REFUSED}"
            raise Refused(RefusalReason.APPROVAL, text, reason="mock on hardware")
        if self.approval.standing(verb.name, peer, callers):
            return None
        own = {name: value for name, value in command.arguments.items() if name in verb.by_name.keys() - LEASE_NAMES}
        wanted = verb.name, peer, callers, digest(own)
        if not self.approval.given(*wanted):
            raise self._unapproved(verb)
        return wanted

    def _refusal_of(self, verb: Verb, exc: Exception, *, checked: bool) -> tuple[Envelope, Refused | None]:
        """Return the answer to a verb that refused, or whose arguments do not fit."""
        if isinstance(exc, ValidationError) and not checked:
            lacking = None if self.robot is None else tasks_refused(self.robot, verb, self.peer_id())
            if lacking is not None:
                return error(lacking), None
            refused = Refused(RefusalReason.ARGUMENTS, str(exc))
            return refused.envelope, refused
        envelope = refusal_envelope(verb.name, exc)
        if isinstance(exc, ValidationError):
            return RefusalReason.ARGUMENTS.noted(envelope), None
        return RefusalReason.LOCKOUT.noted(envelope) if envelope.get("locked") is True else envelope, None

    def _give_leases(self, command: Command, arguments: dict[str, Any]) -> None:
        """Give a verb on the lease its parts."""
        if self.leases is None:
            raise Refused(RefusalReason.CONTROL, f"{command.verb.name}: no robot is registered on this peer.")
        arguments |= {"caller": command.caller, "robot": self.peer_id(), "leases": self.leases}

    def _refuse_unoffered(self, verb: Verb) -> None:
        """Refuse a verb that the robot does not offer, for which no grant would help."""
        lacking = None if self.robot is None else unoffered(self.robot, verb, self.peer_id())
        if lacking is not None:
            raise MotionRefused(error(lacking))

    def _unapproved(self, verb: Verb) -> Refused:
        self._refuse_unoffered(verb)
        text = Approval.refusal(verb.name, self.peer_id())
        return Refused(RefusalReason.APPROVAL, text, reason="the operator has not approved it")

    def _refuse_locked(self, verb: Verb, request: MotionRequest | None) -> None:
        """Refuse a motion of a locked robot, or one older than the last halt."""
        if self.robot is None or verb.while_locked:
            return
        gate = self.robot.gate
        locked = gate.lockout(verb.name)
        if locked is not None:
            gate.note_refused(verb.name, locked)
            text = str(locked.get("reason", "locked"))
            if verb.instead:
                text = f"{text} {verb.instead} works while it is locked, with the operator's approval."
                locked = {**locked, **error(text)}
            raise Refused(RefusalReason.LOCKOUT, text, reason="locked by an emergency stop", envelope=locked)
        busy_with = gate.under_way.name
        if busy_with:
            text = f"{verb.name} is refused: {busy_with} of this robot has not returned."
            raise Refused(RefusalReason.BUSY, text, reason="busy")
        # Halted since the command arrived: refused before a grant is spent on it.
        if request is not None and request.overtaken and (late := gate.refusal(verb.name, request)) is not None:
            raise MotionRefused(late)
