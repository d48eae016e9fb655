"""Lockout of one robot: its state, and the latch of its motion gate.

A robot is locked while it has at least one *epoch*, the id of the emergency stop that locked it, and each epoch is
cleared by itself. At most :data:`MAX_EPOCHS` are told apart; stops beyond that share one overflow epoch, which no
signed resume can name and only an operator at the machine clears.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from strands_robots.envelope import Envelope, error
from strands_robots.safety.scope import EVERY_ROBOT, SCOPE, Scope
from strands_robots.state_files import uptime
from strands_robots.utils import shown

MAX_EPOCHS = 64
"""Epochs told apart, which bounds what a flood of stops can make a robot remember."""

SEEN_MAX = 256
"""Ids of emergency stops remembered besides those that lock; a forgotten one would halt again, on the safe side."""

RESUMED_MAX = 4096
"""Epochs that a robot was resumed from, and never locks by again. Only a resume adds one; the oldest go first."""

CLEARED_MAX = 8
"""Spans of stops that a robot could not tell apart and was cleared of. Beyond it the two oldest become one."""

SKEW_S = 1.0
"""Seconds by which another process may have received a stop earlier."""

LONG_AGO = -1e12
"""Seconds since boot of a moment that nobody knows, before all others."""

OVERFLOW = "overflow"
"""Name of the epoch that stands for every stop beyond the first 64; no 32-hex id equals it."""

Span = tuple[float, float]
"""Two moments in seconds since boot."""

ANY_TIME: Span = (LONG_AGO, math.inf)
"""Times of the stops that an overflow stands for, where none is known."""


_HEX32 = re.compile(r"[0-9a-f]{32}\Z")


def is_epoch(value: object) -> bool:
    """True for 32 lower-case hex digits."""
    return isinstance(value, str) and bool(_HEX32.match(value))


@dataclass(frozen=True, slots=True)
class Lockout:
    """One epoch that locks a robot: ``at`` in wall-clock s, declared ``source``.

    ``scope`` is that of the message that locked it; a stop may have been widened since.
    """

    epoch: str
    source: str = ""
    reason: str = ""
    at: float = 0.0
    scope: Scope = EVERY_ROBOT

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Lockout:
        """Read a lockout that a robot reported, whatever its fields hold."""
        since = row.get("since")
        at = float(since) if isinstance(since, int | float) else 0.0
        epoch, source, reason = (str(row.get(name, "")) for name in ("epoch", "source", "reason"))
        return cls(epoch, source, reason, at, Scope.read(row.get(SCOPE)))

    def fields(self) -> dict[str, Any]:
        """Return the lockout as a robot reports it."""
        stated = {"epoch": self.epoch, "source": self.source, "reason": self.reason, "since": self.at}
        return {**stated, **self.scope.field()}


@dataclass(frozen=True, slots=True)
class LockoutState:
    """Lockouts of a robot, oldest first; with none it may move."""

    lockouts: tuple[Lockout, ...] = ()
    overflow: Lockout | None = None

    @property
    def locked(self) -> bool:
        """True while there is any lockout."""
        return bool(self.lockouts) or self.overflow is not None

    @property
    def all(self) -> tuple[Lockout, ...]:
        """Every lockout, the overflow last."""
        return (*self.lockouts, self.overflow) if self.overflow else self.lockouts

    @property
    def epochs(self) -> tuple[str, ...]:
        """The epochs that lock the robot, oldest first, the overflow last."""
        return tuple(each.epoch for each in self.all)

    @property
    def resumable(self) -> tuple[str, ...]:
        """The epochs that a signed resume can clear."""
        return tuple(each.epoch for each in self.lockouts)

    def can_resume(self, epoch: str) -> bool:
        """Return True when a signed resume can clear ``epoch``."""
        return any(each.epoch == epoch for each in reversed(self.lockouts))

    def engage(self, lockout: Lockout) -> LockoutState:
        """Return the state after an emergency stop; a known epoch changes nothing."""
        if any(each.epoch == lockout.epoch for each in reversed(self.lockouts)):
            return self
        if lockout.epoch != OVERFLOW and len(self.lockouts) < MAX_EPOCHS:
            return LockoutState((*self.lockouts, lockout), self.overflow)
        return self if self.overflow is not None else replace(self, overflow=replace(lockout, epoch=OVERFLOW))

    def resume(self, epoch: str) -> LockoutState:
        """Return the state after a verified resume of ``epoch``."""
        return replace(self, lockouts=tuple(each for each in self.lockouts if each.epoch != epoch))


class LockoutLatch:
    """Lockout of one robot in a running process, with the stops it has seen.

    Readers take no lock: each attribute is one reference that is replaced whole. Writers are the methods, which share
    a lock that no I/O and no robot call is ever made under.

    Attributes:
        state: the lockouts now.
        resumed: epochs that it was resumed from, oldest first.
        cleared: spans of floods that it was cleared of.
        crowd: first and last moment of the stops that the overflow stands for.
    """

    def __init__(
        self,
        robot_id: str,
        state: LockoutState | None = None,
        seen: Iterable[str] = (),
        clock: Callable[[], float] = time.time,
        resumed: Iterable[str] = (),
        *,
        cleared: tuple[Span, ...] = (),
        crowd: Span = ANY_TIME,
    ) -> None:
        self.robot_id = robot_id
        self.state = state or LockoutState()
        self._seen: dict[str, None] = dict.fromkeys([*seen, *self.state.resumable])
        self.resumed = dict.fromkeys(resumed)
        # What comes from now on is noted, so that no later stop counts among those of an unknown time.
        self.cleared, self.crowd = cleared, (crowd[0], min(crowd[1], uptime()))
        self._clock = clock
        self._writing = threading.Lock()

    @property
    def seen(self) -> tuple[str, ...]:
        """Ids that no longer engage, oldest first."""
        with self._writing:
            return tuple(self._seen)

    def crowd_on(self, received: float) -> None:
        """Count a stop that was received then among those of the overflow."""
        since, until = self.crowd
        self.crowd = since, max(until, received + SKEW_S)

    def cleared_of(self, received: float) -> bool:
        """Return True for a stop of this moment that may be one it was cleared of."""
        return any(since <= received <= until for since, until in self.cleared)

    def knows(self, epoch: str) -> bool:
        """Return True for a stop that no longer engages."""
        return epoch in self._seen or epoch in self.resumed

    def refusal(self, verb: str) -> Envelope | None:
        """Return the refusal of ``verb`` while locked, or None while free."""
        state = self.state
        # Asked before every motion: the sentence is made for a refusal only.
        free = not state.lockouts and state.overflow is None
        return None if free else refusal(state, self.robot_id, verb)

    def engage(self, epoch: str, source: str, reason: str, scope: Scope = EVERY_ROBOT) -> bool:
        """Lock under ``epoch``; False, without a change, when it was seen before."""
        with self._writing:
            if epoch in self._seen or epoch in self.resumed:
                return False
            self._seen[epoch] = None
            crowded = self.state.overflow is not None
            self.state = self.state.engage(Lockout(epoch, source, reason, self._clock(), scope))
            if self.state.overflow is not None and not crowded:
                self.crowd = uptime() - SKEW_S, uptime() + SKEW_S
            if len(self._seen) > SEEN_MAX + MAX_EPOCHS:
                self._forget()
            return True

    def inherit(self, state: LockoutState, crowd: Span) -> None:
        """Take over lockouts, except what was resumed here since.

        Args:
            state: with them.
            crowd: first and last moment of the stops that its overflow stands for.
        """
        own = self.crowd if self.state.overflow is not None else crowd
        for each in state.all:
            self.engage(each.epoch, each.source, each.reason, each.scope)
        if state.overflow is not None:
            with self._writing:
                self.crowd = min(own[0], crowd[0]), max(own[1], crowd[1])

    def resume(self, epoch: str) -> None:
        """Clear ``epoch`` after its resume was verified."""
        with self._writing:
            self.state = self.state.resume(epoch)
            self._add_resumed([epoch])

    def clear(self) -> tuple[Lockout, ...]:
        """Clear every lockout, for an operator at this machine; return them."""
        with self._writing:
            self.cleared = with_cleared(self.cleared, self.state, self.crowd)
            cleared, self.state = self.state.all, LockoutState()
            self._add_resumed(self._seen)
            return cleared

    def forgo(self, epochs: Iterable[str], cleared: tuple[Span, ...] = ()) -> None:
        """Never lock by these again, as after their resume."""
        with self._writing:
            self._add_resumed(epochs)
            self.cleared = (*cleared, *self.cleared)[-CLEARED_MAX:] if cleared else self.cleared

    def _add_resumed(self, epochs: Iterable[str]) -> None:
        self.resumed = with_resumed(self.resumed, epochs)

    def _forget(self) -> None:
        active = set(self.state.resumable)
        oldest = next(epoch for epoch in self._seen if epoch not in active)
        del self._seen[oldest]


def with_cleared(cleared: tuple[Span, ...], state: LockoutState, crowd: Span) -> tuple[Span, ...]:
    """Return the spans with that of an overflow that is cleared now, if any.

    It ends with the last stop that was received: a later one, which the robot missed, still counts.
    """
    if state.overflow is None:
        return cleared
    spans = (*cleared, (crowd[0], min(crowd[1], uptime())))
    return spans if len(spans) <= CLEARED_MAX else ((spans[0][0], spans[1][1]), *spans[2:])


def with_resumed(resumed: dict[str, None], epochs: Iterable[str]) -> dict[str, None]:
    """Return the latest resumed epochs with these; the same where all are known."""
    new = [each for each in epochs if each not in resumed and each != OVERFLOW]
    return dict.fromkeys([*resumed, *new][-RESUMED_MAX:]) if new else resumed


def refusal(state: LockoutState, robot_id: str, verb: str) -> Envelope | None:
    """Return a locked robot's refusal of ``verb``; None while free."""
    if not state.locked:
        return None
    first = state.all[0]
    why = f" ({shown(first.reason)})" if first.reason else ""
    more = len(state.all) - 1
    scope = "" if first.scope.everything else f" for {first.scope}"
    others = f" and {more} more stop{'s' if more > 1 else ''}" if more else ""
    return error(
        f"{verb} is refused: {robot_id} is locked by the emergency stop of {first.source or 'an unnamed source'}"
        f"{scope}{why}, epoch {first.epoch}{others}, since {utc(first.at)}. "
        f"To resume: {how_to_resume(state, robot_id)}.",
        locked=True,
        robot=robot_id,
        refused=verb,
        epochs=list(state.epochs),
        stopped_by=first.source,
        stop_reason=first.reason,
        since=first.at,
        **first.scope.field(),
    )


def how_to_resume(state: LockoutState, robot_id: str) -> str:
    """Return the commands that free this robot, for an operator."""
    local = "`strands-robots resume --local` at its own machine"
    if state.overflow is not None:
        return local
    return f"`strands-robots resume --key FILE --targets {robot_id}`, or {local}"


def utc(at: float) -> str:
    """Return wall-clock seconds as ISO 8601 UTC, or as a number if too large."""
    try:
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at))
    except (OverflowError, ValueError, OSError):
        return f"{at:g}"
