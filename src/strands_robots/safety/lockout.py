"""The lockout of one robot, as a pure state machine: state, event and time in; state and effects out.

A robot is locked while it holds at least one *epoch*, the id of the emergency stop that locked it, and each epoch
is cleared by itself. At most :data:`MAX_EPOCHS` are told apart; stops beyond that share one overflow epoch, which
no signed resume can name and only an operator at the machine clears.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from strands_robots.envelope import Envelope, error
from strands_robots.utils import shown

MAX_EPOCHS = 64
"""Epochs held apart, which bounds what a flood of stops can make a robot remember."""

OVERFLOW = "overflow"
"""Name of the epoch that stands for every stop beyond the first 64; no 32-hex id equals it."""


@dataclass(frozen=True, slots=True)
class Hold:
    """One reason why a robot is locked: ``at`` in seconds of wall-clock time, ``source`` as the stop declared it."""

    epoch: str
    source: str
    reason: str
    at: float


@dataclass(frozen=True, slots=True)
class LockoutState:
    """What a robot holds, oldest first. The empty state is a robot that may move."""

    holds: tuple[Hold, ...] = ()
    overflow: Hold | None = None

    @property
    def locked(self) -> bool:
        """True while any epoch is held."""
        return bool(self.holds) or self.overflow is not None

    @property
    def all(self) -> tuple[Hold, ...]:
        """Every hold, the overflow last."""
        return (*self.holds, self.overflow) if self.overflow else self.holds

    @property
    def epochs(self) -> tuple[str, ...]:
        """The epochs held, oldest first, the overflow last."""
        return tuple(hold.epoch for hold in self.all)

    @property
    def resumable(self) -> tuple[str, ...]:
        """The epochs that a signed resume can clear."""
        return tuple(hold.epoch for hold in self.holds)

    def holds_epoch(self, epoch: str) -> bool:
        """True when ``epoch`` is one of those held."""
        return any(hold.epoch == epoch for hold in self.holds)


@dataclass(frozen=True, slots=True)
class Engage:
    """An emergency stop arrived."""

    epoch: str
    source: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Resume:
    """A resume that was verified names ``epoch``."""

    epoch: str


@dataclass(frozen=True, slots=True)
class ClearLocal:
    """An operator at the robot's own machine clears every epoch, the overflow included."""

    who: str


Event = Engage | Resume | ClearLocal


@dataclass(frozen=True, slots=True)
class Engaged:
    """``hold`` is held now. ``first``: the robot was free before."""

    hold: Hold
    first: bool


@dataclass(frozen=True, slots=True)
class Duplicate:
    """The epoch was held already; nothing changed."""

    epoch: str


@dataclass(frozen=True, slots=True)
class Cleared:
    """``holds`` are gone. ``free``: nothing is held any more."""

    holds: tuple[Hold, ...]
    free: bool


@dataclass(frozen=True, slots=True)
class NotHeld:
    """There was nothing to clear."""

    epoch: str


Effect = Engaged | Duplicate | Cleared | NotHeld


def step(state: LockoutState, event: Event, now: float) -> tuple[LockoutState, Effect]:
    """The state after ``event`` at wall-clock time ``now``, and what that did."""
    if isinstance(event, Engage):
        return _engage(state, event, now)
    if isinstance(event, Resume):
        return _resume(state, event.epoch)
    if not state.locked:
        return state, NotHeld("")
    return LockoutState(), Cleared(state.all, free=True)


def _engage(state: LockoutState, event: Engage, now: float) -> tuple[LockoutState, Effect]:
    if state.holds_epoch(event.epoch):
        return state, Duplicate(event.epoch)
    hold = Hold(event.epoch, event.source, event.reason, now)
    effect = Engaged(hold, first=not state.locked)
    if event.epoch != OVERFLOW and len(state.holds) < MAX_EPOCHS:
        return replace(state, holds=(*state.holds, hold)), effect
    if state.overflow is not None:
        return state, Duplicate(OVERFLOW)
    hold = replace(hold, epoch=OVERFLOW)
    return replace(state, overflow=hold), Engaged(hold, first=effect.first)


def _resume(state: LockoutState, epoch: str) -> tuple[LockoutState, Effect]:
    if not state.holds_epoch(epoch):
        return state, NotHeld(epoch)
    gone = tuple(hold for hold in state.holds if hold.epoch == epoch)
    rest = replace(state, holds=tuple(hold for hold in state.holds if hold.epoch != epoch))
    return rest, Cleared(gone, free=not rest.locked)


def refusal(state: LockoutState, robot_id: str, verb: str) -> Envelope | None:
    """The answer to ``verb`` of a locked robot: which epoch, who stopped it, how to resume; None while free."""
    if not state.locked:
        return None
    hold = state.all[0]
    why = f" ({shown(hold.reason)})" if hold.reason else ""
    more = len(state.all) - 1
    others = f" and {more} more stop{'s' if more > 1 else ''}" if more else ""
    return error(
        f"{verb} is refused: {robot_id} is locked by the emergency stop of {hold.source or 'an unnamed source'}{why}, "
        f"epoch {hold.epoch}{others}, since {utc(hold.at)}. To resume: {how_to_resume(state, robot_id)}.",
        locked=True,
        robot=robot_id,
        refused=verb,
        epochs=list(state.epochs),
        stopped_by=hold.source,
        stop_reason=hold.reason,
        since=hold.at,
    )


def how_to_resume(state: LockoutState, robot_id: str) -> str:
    """The commands that free this robot, in words for an operator."""
    local = "`strands-robots resume --local` at its own machine"
    if state.overflow is not None:
        return local
    return f"`strands-robots resume --key FILE --targets {robot_id}`, or {local}"


def utc(at: float) -> str:
    """Wall-clock seconds as ISO 8601 UTC; a time that no calendar holds is shown as its number."""
    try:
        return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at))
    except (OverflowError, ValueError, OSError):
        return f"{at:g}"
