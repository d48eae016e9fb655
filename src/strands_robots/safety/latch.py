"""The lockout of one robot in a running process: the state machine behind one short lock, read without it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from strands_robots.envelope import Envelope
from strands_robots.safety import lockout
from strands_robots.safety.lockout import ClearLocal, Effect, Engage, LockoutState, Resume

SEEN_MAX = 256
"""Ids of emergency stops remembered besides those held; a forgotten one would halt again, which is the safe side."""


class LockoutLatch:
    """Who holds this robot, and which emergency stops it has seen. Implements :class:`~.gate.Latch`.

    Readers take no lock: the state is one reference that is replaced whole. Writers share a lock that no I/O and
    no robot call is ever made under.
    """

    def __init__(
        self,
        robot_id: str,
        state: LockoutState | None = None,
        seen: Iterable[str] = (),
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.robot_id = robot_id
        self._state = state or LockoutState()
        self._seen: dict[str, None] = dict.fromkeys([*seen, *self._state.resumable])
        self._clock = clock
        self._writing = threading.Lock()

    @property
    def state(self) -> LockoutState:
        """What is held now."""
        return self._state

    @property
    def seen(self) -> tuple[str, ...]:
        """Ids that no longer engage, oldest first."""
        with self._writing:
            return tuple(self._seen)

    def refusal(self, verb: str) -> Envelope | None:
        """The refusal of ``verb`` while locked, or None while free."""
        return lockout.refusal(self._state, self.robot_id, verb)

    def engage(self, epoch: str, source: str, reason: str) -> Effect | None:
        """Hold ``epoch``; None when this id was seen before, which changes nothing."""
        with self._writing:
            if epoch in self._seen:
                return None
            self._seen[epoch] = None
            effect = self._step(Engage(epoch, source, reason))
            self._forget()
            return effect

    def resume(self, epoch: str) -> Effect:
        """Clear ``epoch`` after its resume was verified."""
        with self._writing:
            return self._step(Resume(epoch))

    def clear_local(self, who: str) -> Effect:
        """Clear everything at the word of an operator at this machine."""
        with self._writing:
            return self._step(ClearLocal(who))

    def _step(self, event: lockout.Event) -> Effect:
        self._state, effect = lockout.step(self._state, event, self._clock())
        return effect

    def _forget(self) -> None:
        if len(self._seen) <= SEEN_MAX + lockout.MAX_EPOCHS:
            return
        held = set(self._state.resumable)
        oldest = next(epoch for epoch in self._seen if epoch not in held)
        del self._seen[oldest]
