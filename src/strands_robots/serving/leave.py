"""Leave of a command to begin: one question, with one answer or a refusal.

In order: caller, control lease, lockout, the operator's approval. The first that refuses raises :class:`Refused`, which
says which it was. A call that is refused must not keep others from moving, so the robot is held, and a grant claimed,
when nothing has refused; :meth:`Leave.settle` gives both back where the robot then starts nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.contract import Robot
from strands_robots.envelope import error
from strands_robots.safety.authorization import Approval, Leave, digest
from strands_robots.safety.gate import MotionRefused, MotionRequest
from strands_robots.serving.control import ControlLeases, NotHolderError
from strands_robots.serving.offered_verbs import unoffered
from strands_robots.serving.policy_arguments import MOCK, mock_refusal
from strands_robots.serving.refused import RefusalReason, Refused
from strands_robots.serving.verbs import LEASE_ID, LEASE_NAMES, LEASE_TTL_S, Arguments, Kind, Verb


@dataclass(frozen=True)
class Command:
    """One call of a verb, as a network received it.

    Attributes:
        arguments: unchecked, as the caller gave them.
        caller: the caller's declared name, or whatever stood in its place.
        request: made of the robot's gate when the command arrived; None for a peer without a robot.
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


Authorize = Callable[[Command, Arguments], Collection[str] | None]
"""Raises :class:`Refused` where the caller may not; :mod:`strands_robots.safety.authorization` decides.

Returns the names by which an approval may know the caller, None without any.
"""

_Terms = tuple[str, str | None, float]
"""``lease_id``, the robot of a world (None for all of them) and ``lease_ttl_s`` of a motion under a lease."""


@dataclass
class MotionRules:
    """Rules by which the commands of one robot on one network may begin.

    Attributes:
        robot: behind its contract; None for a peer that only watches and commands.
        peer_id: gives the name that the operator's approval is for.
        hardware: True where a motion needs the operator's approval besides the caller's authorization.
        authorize: the network's question to the caller.
        approval: the operator's.
        leases: who holds the robot, on every network.
    """

    robot: Robot | None
    peer_id: Callable[[], str]
    hardware: bool
    authorize: Authorize
    approval: Approval = field(default_factory=Approval)
    leases: ControlLeases | None = None

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
        try:
            callers = self.authorize(command, arguments) or ()
        except Refused:
            self._refuse_unoffered(verb)
            raise
        terms = self._terms(command, arguments)
        if verb.kind is not Kind.MOTION:
            return Leave()
        self._admit(command, terms, hold=False)
        self._refuse_locked(verb, command.request)
        if not self.hardware:
            return self._admit(command, terms)
        if arguments.get("policy_provider") == MOCK and getattr(self.robot, "runs_policies", False):
            refusal = mock_refusal()
            if refusal is not None:
                raise Refused(RefusalReason.APPROVAL, f"{verb.name} is refused: {refusal}", reason="mock on hardware")
        own = {name: value for name, value in command.arguments.items() if name in verb.by_name.keys() - LEASE_NAMES}
        wanted = verb.name, self.peer_id(), callers, digest(own)
        if not self.approval.given(*wanted):
            raise self._unapproved(verb)
        held = self._admit(command, terms)
        claimed = None
        try:
            claimed = self.approval.claim(*wanted)
        finally:
            if claimed is None:
                held.settle(begun=False)
        if claimed is None:
            raise self._unapproved(verb)
        return Leave(held.settle, claimed.settle)

    def _terms(self, command: Command, arguments: dict[str, Any]) -> _Terms | None:
        """Take the lease's arguments out; give the lease's verbs their parts.

        Returns:
            None where no lease is asked.
        """
        verb = command.verb
        if verb.on_lease:
            if self.leases is None:
                raise Refused(RefusalReason.CONTROL, f"{verb.name}: no robot is registered on this peer.")
            arguments |= {"caller": command.caller, "robot": self.peer_id(), "leases": self.leases}
            return None
        if not verb.leased:
            return None
        lease_id, ttl_s = arguments.pop(LEASE_ID, "") or "", arguments.pop(LEASE_TTL_S, 0.0) or 0.0
        if ttl_s and not lease_id:
            raise Refused(RefusalReason.ARGUMENTS, f"{LEASE_TTL_S} needs a {LEASE_ID}: a secret of the caller's own.")
        return lease_id, None if verb.of_world else arguments.get("robot_name", ""), ttl_s

    def _admit(self, command: Command, terms: _Terms | None, *, hold: bool = True) -> Leave:
        if terms is None or self.leases is None:
            return Leave()
        try:
            return self.leases.admit(command.verb.name, command.caller, *terms, hold=hold, begun=lambda: command.begun)
        except NotHolderError as exc:
            raise Refused(RefusalReason.CONTROL, str(exc), envelope=exc.envelope) from None

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
        late = self.robot.gate.refusal(verb.name, request)
        if late is not None:
            raise MotionRefused(late)
