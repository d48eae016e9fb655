"""One robot's motion gate: permits to move, revoked at once by a halt and not given while locked.

Every motion source (a rollout, a teleoperation session, a single ``send_action``) asks :meth:`MotionGate.permit`
before it moves and looks at :attr:`Permit.valid` under the same lock as each write to the device. A halt calls
:meth:`MotionGate.revoke` first and then waits for the write that may be in flight, so that after its verdict no
action reaches the device. Revoking is one assignment: it takes no lock and cannot be held up.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from typing import Protocol

from strands_robots.envelope import Envelope, error


class Latch(Protocol):
    """What may hold a robot still: the lockout."""

    def refusal(self, verb: str) -> Envelope | None:
        """The refusal of ``verb`` while locked, or None while clear."""


class MotionRefused(RuntimeError):  # noqa: N818 - a refusal, not a fault
    """Motion is not allowed now; ``envelope`` is the answer to give."""

    def __init__(self, envelope: Envelope) -> None:
        super().__init__(str(envelope.get("reason", "motion refused")))
        self.envelope = envelope


class PermitVoidError(RuntimeError):
    """The permit was void when the write came: the motion was stopped in between, and nothing was written."""


class Permit:
    """Leave to move, until the next halt or until whoever started the motion withdraws it."""

    __slots__ = ("_gate", "_generation", "_withdrawn", "verb")

    def __init__(self, gate: MotionGate, generation: int, verb: str) -> None:
        self._gate = gate
        self._generation = generation
        self._withdrawn = False
        self.verb = verb

    @property
    def valid(self) -> bool:
        """False for ever once the robot was halted or locked, or this permit withdrawn."""
        return not (self._withdrawn or self.revoked)

    @property
    def revoked(self) -> bool:
        """True for ever once the whole robot was halted or locked: whoever did that also freezes it."""
        return self._gate.generation != self._generation

    def withdraw(self) -> None:
        """Void this permit alone: one motion stops, the robot stays free."""
        self._withdrawn = True


class MotionGate:
    """The gate of one robot. Thread-safe without a lock: the generation is one reference, replaced whole."""

    def __init__(self, latch: Latch | None = None) -> None:
        self._latch = latch
        self._numbers = count(1)
        self._generation = 0
        self._asked = threading.local()

    @property
    def generation(self) -> int:
        """Rises with every halt; permits of an older one are void."""
        return self._generation

    def attach(self, latch: Latch) -> None:
        """Let ``latch`` decide from now on whether motion is locked."""
        self._latch = latch

    @contextmanager
    def asked_at(self, generation: int) -> Iterator[None]:
        """For this thread: motions begun inside were asked for at ``generation``; a halt since then refuses them.

        A call that waited for a thread or a connection is thus older than the stop that came meanwhile.
        """
        self._asked.generation = generation
        try:
            yield
        finally:
            del self._asked.generation

    def refusal(self, verb: str) -> Envelope | None:
        """The answer to ``verb`` while locked, or when the robot was halted since it was asked for; else None."""
        if getattr(self._asked, "generation", self._generation) != self._generation:
            return error(f"{verb} is refused: the robot was halted after it was asked for; nothing was started.")
        return self._latch.refusal(verb) if self._latch is not None else None

    def permit(self, verb: str) -> Permit:
        """Leave to move. Raises :class:`MotionRefused` while locked, and when halted since it was asked for."""
        # The generation is read before the latch, so that a lock engaged in between voids this permit.
        permit = Permit(self, getattr(self._asked, "generation", self._generation), verb)
        refusal = self.refusal(verb)
        if refusal is not None:
            raise MotionRefused(refusal)
        return permit

    def revoke(self) -> None:
        """Void every permit given so far."""
        self._generation = next(self._numbers)
