"""The action that is due, and the moment to ask for the next chunk.

A position counts the policy's own steps, of which there are ``rate`` in a second. It goes on only while an action is
played, so a robot that waits for its policy misses nothing of the path. A chunk begins at the position of its
observation: what was played while it was computed is stale and is never played.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from strands_robots.policies.base import Action

LATENCIES = 10
"""Latencies of which the worst decides when to ask."""

_EXACT = 1e-6
"""Part of a step that is none: 50 Hz and 25 Hz meet at every second tick."""


class Playback:
    """Position in a policy's steps, and the chunk that is played there.

    Args:
        rate: the policy's steps a second.
        hz: control steps a second, at least ``rate``; between two actions it interpolates.
        horizon: actions that are played of each chunk; None for all.
    """

    def __init__(self, *, rate: float, hz: float, horizon: int | None = None) -> None:
        self.position = 0.0
        self.stale = 0
        """Actions that came too late to be played."""
        self._rate = rate
        self._hz = hz
        self._horizon = horizon
        self._actions: Sequence[Action] = ()
        self._base = 0.0
        self._end = 0.0
        self._observed_at: float | None = None
        self._playing = False
        self._latencies: deque[float] = deque(maxlen=LATENCIES)

    @property
    def latency_s(self) -> float:
        """The worst of the last latencies; 0 before the first."""
        return max(self._latencies, default=0.0)

    @property
    def delay(self) -> int:
        """Steps that will be played before an answer that is asked for now has come."""
        return math.ceil(self.latency_s * self._rate - _EXACT)

    @property
    def played(self) -> int:
        """Actions of the present chunk that were played or are stale."""
        return min(len(self._actions), math.ceil(self.position - self._base - _EXACT))

    @property
    def left(self) -> float:
        """Steps until the chunk is over."""
        return self._end - self.position

    def advance(self, ticks: int = 1) -> None:
        """Go on by ``ticks`` control steps, more than one where some were missed."""
        if not self._playing:
            return
        self.position = min(self.position + ticks * self._rate / self._hz, self._end)
        if self._end - self.position < _EXACT:
            self.position = self._end
        self._playing = False

    def due(self, ahead: int = 0) -> bool:
        """Return True when it is time to ask, ``ahead`` control steps from now."""
        # One step more, because an answer is played at the control step after it came.
        lead = self.delay + (1 if self.latency_s > 0 else 0)
        if lead >= self._end - self._base:
            # The whole answer would be stale; the robot has to wait for it anyway.
            lead = 0
        return self.left - ahead * self._rate / self._hz <= lead + _EXACT

    def take(self, actions: Sequence[Action], asked_at: float, observed_at: float, latency_s: float) -> int:
        """Replace the chunk by one that was asked for at the position ``asked_at``.

        Returns the number of its actions that are stale.
        """
        self._latencies.append(latency_s)
        usable = len(actions) if self._horizon is None else min(len(actions), self._horizon)
        stale = min(usable, math.ceil(self.position - asked_at - _EXACT))
        self.stale += stale
        if stale < usable:
            self._actions, self._base, self._end = actions, asked_at, asked_at + usable
            self._observed_at = observed_at
        return stale

    def play(self) -> Action | None:
        """Return the action of this position, None where the chunk is over."""
        at = self.position - self._base
        if self.left < _EXACT or not self._actions:
            return None
        self._playing = True
        first = math.floor(at + _EXACT)
        part = at - first
        if part < _EXACT or first + 1 >= len(self._actions):
            return dict(self._actions[first])
        before, after = self._actions[first], self._actions[first + 1]
        return {key: value + part * (after[key] - value) for key, value in before.items()}

    def age_s(self, now: float) -> float:
        """Return the age of the observation that the present chunk answers, in seconds."""
        return 0.0 if self._observed_at is None else now - self._observed_at

    def clear(self) -> None:
        """Drop the chunk."""
        self._actions, self._end = (), self.position
        self._playing = False
