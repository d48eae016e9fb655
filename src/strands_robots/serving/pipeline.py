"""Pipeline of a command from any network to a robot's method.

In order: arguments, caller, control lease, lockout, the operator's approval, the robot's method. The first that refuses
raises :class:`Refused`, which says which it was. The robot is held and a grant is claimed when nothing has refused, and
both are given back where the robot then starts nothing. Whatever is raised on the way becomes an
:class:`Result` here alone. Stops take no part in it: they go to the stop executor at once, for every caller.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from enum import Enum
from typing import Any
from weakref import WeakKeyDictionary

from strands_robots.contract import Robot, body_of
from strands_robots.envelope import Envelope, error, is_error
from strands_robots.errors import StrandsRobotsError
from strands_robots.identity_map import IdentityMap
from strands_robots.safety.approval import Approval, Claim, digest
from strands_robots.safety.gate import REFUSALS, Asked, MotionGate, MotionRefused, refusal_envelope
from strands_robots.serving.admissions import Admission
from strands_robots.serving.control import ControlLeases, NotHolderError, leases_of
from strands_robots.serving.policy_arguments import MOCK, mock_refusal
from strands_robots.serving.verbs import LEASE_ID, LEASE_NAMES, LEASE_TTL_S, Arguments, Kind, Verb
from strands_robots.serving.workers import Share, Shares, shares_of
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError

logger = stop_logger(__name__)


class RefusalReason(Enum):
    """The part of the pipeline that refused a command."""

    ARGUMENTS = "arguments"
    CALLER = "caller"
    CONTROL = "control"
    LOCKOUT = "lockout"
    APPROVAL = "approval"
    BUSY = "busy"
    FAILED = "failed"


class Refused(StrandsRobotsError):  # noqa: N818 - a refusal, not a fault
    """A command that did not reach the robot, or failed in it.

    Args:
        text: what the caller is told.
        reason: what the audit is told; ``text`` by default.
        envelope: the whole answer, where it is more than ``text``.
    """

    def __init__(self, why: RefusalReason, text: str, reason: str = "", envelope: Envelope | None = None) -> None:
        super().__init__(text)
        self.why = why
        self.reason = reason or text
        self.envelope = _refused(error(text) if envelope is None else envelope, why)


def _refused(envelope: Envelope, why: RefusalReason) -> Envelope:
    """Return the envelope with the part that refused, for callers that are programs."""
    return {**envelope, "refused": why.value}


def _own_refusal(verb: str, refused: Exception) -> Envelope:
    """Return the answer to a verb that refused by itself."""
    envelope = refusal_envelope(verb, refused)
    if isinstance(refused, ValidationError):
        return _refused(envelope, RefusalReason.ARGUMENTS)
    return _refused(envelope, RefusalReason.LOCKOUT) if envelope.get("locked") is True else envelope


@dataclass(frozen=True)
class Command:
    """One call of a verb, as a network received it.

    Attributes:
        arguments: unchecked, as the caller gave them.
        caller: the caller's declared name, or whatever stood in its place.
        asked: the robot's gate when the command arrived; None for a peer without a robot.
        proof: what the network knows of the sender besides its name.
    """

    verb: Verb
    arguments: Mapping[str, Any]
    caller: object = None
    asked: Asked | None = None
    proof: Any = None


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

Own = Callable[[Arguments], object]
"""Carries out a verb that is the network peer's own and not its robot's."""


Admit = Callable[[bool], Admission]
"""Asks the control lease for a motion, and holds the robot for it where the argument is True."""


@dataclass
class Leave:
    """Leave of one motion to begin: the robot, and the operator's approval."""

    admission: Admission = field(default_factory=Admission)
    claim: Claim = field(default_factory=Claim)

    def close(self, begun: bool) -> None:
        """Spend the grant of a motion that has begun; give back all else."""
        self.admission.close(begun)
        if begun:
            self.claim.spend()
        else:
            self.claim.give_back()


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
        self._pending: WeakKeyDictionary[Asked, str] = shared._pending if shared else WeakKeyDictionary()

    def of(self, robot: str) -> PendingCommands:
        """The same commands, for the peer of one robot of the world."""
        return PendingCommands(self._gate, robot, self)

    def arrive(self, robot: str = "") -> Asked | None:
        """Note a command's arrival; what it begins may be no older than this."""
        if self._gate is None:
            return None
        asked = self._gate.asked()
        with self._lock:
            self._pending[asked] = self._robot or robot
        return asked

    def serving(self, asked: Asked | None) -> AbstractContextManager[None]:
        """The time in which this thread carries the command out."""
        return nullcontext() if self._gate is None or asked is None else self._gate.asked_at(asked)

    def void(self, robot: str = "") -> None:
        """Void pending commands of this robot of the world, because it is stopped."""
        name = robot or self._robot
        with self._lock:
            for asked, named in self._pending.items() if name else ():
                if named in (name, ""):
                    asked.give_up()


_PENDING: IdentityMap[PendingCommands] = IdentityMap()


@dataclass
class Pipeline:
    """Serves the commands of one robot on one network.

    Attributes:
        robot: behind its contract; None for a peer that only watches and commands.
        peer_id: gives the name that the operator's approval is for.
        hardware: True where a motion needs the operator's approval besides the caller's authorization.
        authorize: the network's question to the caller.
        own: verbs that the peer carries out itself, by name.
        pending: commands that a stop has to reach before they begin.
        shares: the robot's threads.
        leases: who holds the robot, on every network.
    """

    robot: Robot | None
    peer_id: Callable[[], str]
    hardware: bool
    authorize: Authorize
    approval: Approval = field(default_factory=Approval)
    own: Mapping[str, Own] = field(default_factory=dict)
    pending: PendingCommands = field(default_factory=lambda: PendingCommands(None))
    shares: Shares = field(default_factory=Shares)
    leases: ControlLeases | None = None
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
            callers = self.authorize(command, arguments) or ()
            admit = self._control(command, arguments)
            with self.pending.serving(command.asked):
                if verb.kind is Kind.MOTION:
                    self._give_leave(leave, command, arguments, admit, callers)
                # Of what ends in an exception nobody knows whether it moves.
                begun = True
                if verb.name in self.own:
                    result = self.own[verb.name](arguments)
                elif self.robot is None:
                    result = error(f"{verb.name}: no robot is registered on this peer.")
                elif verb.run is not None:
                    result = verb.run(self.robot, arguments)
                else:
                    result = getattr(self.robot, verb.method)(**arguments)
                begun = not is_error(result)
        except Refused as refused:
            refusal, result, begun = refused, refused.envelope, False
        except NotHolderError as exc:
            result, begun = _refused(exc.envelope, RefusalReason.CONTROL), False
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
                leave.close(begun or (command.asked is not None and command.asked.begun))
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
            raise Refused(RefusalReason.ARGUMENTS, str(exc)) from None

    def _control(self, command: Command, arguments: dict[str, Any]) -> Admit:
        """Return a motion's question to the lease; give the lease's verbs their parts."""
        verb, leases = command.verb, self.leases
        if verb.on_lease:
            if leases is None:
                raise Refused(RefusalReason.CONTROL, f"{verb.name}: no robot is registered on this peer.")
            arguments |= {"caller": command.caller, "robot": self.peer_id(), "leases": leases}
            return lambda hold: Admission()
        if not verb.leased:
            return lambda hold: Admission()
        lease_id, ttl_s = arguments.pop(LEASE_ID, "") or "", arguments.pop(LEASE_TTL_S, 0.0) or 0.0
        if ttl_s and not lease_id:
            raise Refused(RefusalReason.ARGUMENTS, f"{LEASE_TTL_S} needs a {LEASE_ID}: a secret of the caller's own.")
        name = None if verb.of_world else arguments.get("robot_name", "")

        def admit(hold: bool) -> Admission:
            if leases is None:
                return Admission()
            try:
                admission = leases.admit(verb.name, command.caller, lease_id, name, ttl_s, hold=hold)
            except NotHolderError as exc:
                raise Refused(RefusalReason.CONTROL, str(exc), envelope=exc.envelope) from None
            admission.begun = lambda: command.asked is not None and command.asked.begun
            return admission

        return admit

    def _give_leave(
        self, leave: Leave, command: Command, arguments: Arguments, admit: Admit, callers: Collection[str]
    ) -> None:
        """Ask all whether the motion may begin, then hold the robot and claim a grant.

        A call that is refused must not keep others from moving, so nothing is held before.
        """
        verb = command.verb
        admit(False)
        self._refuse_locked(verb)
        if not self.hardware:
            leave.admission = admit(True)
            return
        if arguments.get("policy_provider") == MOCK and getattr(self.robot, "runs_policies", False):
            refusal = mock_refusal()
            if refusal is not None:
                raise Refused(RefusalReason.APPROVAL, f"{verb.name} is refused: {refusal}", reason="mock on hardware")
        own = {name: value for name, value in command.arguments.items() if name in verb.by_name.keys() - LEASE_NAMES}
        wanted = verb.name, self.peer_id(), callers, digest(own)
        if self.approval.given(*wanted):
            leave.admission = admit(True)
            claim = self.approval.claim(*wanted)
            if claim is not None:
                leave.claim = claim
                return
        text = Approval.refusal(verb.name, self.peer_id())
        raise Refused(RefusalReason.APPROVAL, text, reason="the operator has not approved it")

    def _refuse_locked(self, verb: Verb) -> None:
        """Refuse a motion of a locked robot, or one older than the last halt."""
        if self.robot is None or verb.while_locked:
            return
        locked = self.robot.gate.lockout(verb.name)
        if locked is not None:
            text = str(locked.get("reason", "locked"))
            if verb.instead:
                text = f"{text} {verb.instead} works while it is locked, with the operator's approval."
                locked = {**locked, **error(text)}
            raise Refused(RefusalReason.LOCKOUT, text, reason="locked by an emergency stop", envelope=locked)
        busy_with = self.robot.gate.under_way.name
        if busy_with:
            text = f"{verb.name} is refused: {busy_with} of this robot has not returned."
            raise Refused(RefusalReason.BUSY, text, reason="busy")
        # Halted since the command arrived: refused before a grant is spent on it.
        late = self.robot.gate.refusal(verb.name)
        if late is not None:
            raise MotionRefused(late)
