"""A leader, a wire and a robot in time that is computed: commands late, lost, doubled, reordered, replayed.

The robot is the product's own judge and control step; the wire knows each command's true age.
"""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass
from typing import Any

from strands_robots.policies.freshness import SPARE_S
from strands_robots.policies.handover import Lead, LeaderCommand, LedPolicy

BEAT_S = 0.02
JITTER_S = 0.005
DOUBLED, LATE, REPLAYED = 0.05, 0.03, 20
"""Part of the commands that comes twice, and that comes up to half a second late; commands that are replayed."""

OUTAGE_EVERY_S, OUTAGE_MAX_S, SHORT_OUTAGE_S, LATE_MAX_S, IN_ORDER_S = 2.0, 3.0, 0.3, 0.5, 1e-4
CLOCKS_APART_S = 1234.5
PER_VALUE = 1e-7
"""A command's number as a target: the target says which command is carried out."""


@dataclass(frozen=True, slots=True)
class Weather:
    """What the wire does."""

    one_way_s: float
    loss: float = 0.0
    faults: bool = True
    """Doubled, late and reordered commands, outages, and replays after them."""


@dataclass
class Carried:
    """What a run has shown."""

    sent: int = 0
    carried: int = 0
    stale: int = 0
    holds: int = 0
    dropped: int = 0
    oldest_s: float = 0.0
    """Greatest true age of a command that was carried out, at its arrival."""


class Wire:
    """One run: ``commands`` at fifty a second over ``weather``."""

    def __init__(self, weather: Weather, seed: int = 1) -> None:
        self._weather, self._random = weather, random.Random(seed)
        self._at = 0.0
        self._lead = Lead("hand", now=lambda: self._at)
        self._policy = LedPolicy(self._lead, None, max_speed=20.0, period=BEAT_S)
        self._policy.reset("", {"pan": (-1.0, 1.0)})
        self._joints = {"pan": 0.0}
        self._events: list[tuple[float, int, str, Any]] = []
        self._order = 0
        self._arrived: dict[int, float] = {}
        self._made: dict[int, float] = {}
        self._turn, self._gripped = 1, 0.0
        self._told, self._told_at, self._state = 0.0, 0.0, ("held", 0)
        self._outage: tuple[float, float] = (0.0, 0.0)
        self._flush, self._last = 0.0, -1
        self.found = Carried()

    def run(self, commands: int) -> Carried:
        """Send so many, and return what was carried out."""
        self._put(0.0, "send", 0)
        self._put(0.5 * BEAT_S, "beat", None)
        while self._events:
            self._at, _, kind, what = heapq.heappop(self._events)
            if kind == "send":
                self._send(what)
                if what + 1 < commands:
                    self._put(self._at + BEAT_S * self._random.uniform(0.95, 1.05), "send", what + 1)
            elif kind == "arrive":
                self._arrive(what)
            elif kind == "answer":
                self._answered(*what)
            else:
                self._beat()
                if self.found.sent < commands:
                    self._put(self._at + BEAT_S, "beat", None)
        self.found.holds = self._lead.counts.holds
        self.found.dropped = self._lead.counts.stale + self._lead.counts.disordered
        return self.found

    def _put(self, at: float, kind: str, what: Any) -> None:
        self._order += 1
        heapq.heappush(self._events, (at, self._order, kind, what))

    def _way(self) -> float:
        return max(0.0, self._weather.one_way_s + self._random.uniform(-JITTER_S, JITTER_S))

    def _send(self, seq: int) -> None:
        number = seq + 1
        state, turn = self._state
        if state == "held" and turn >= self._turn and self._at - self._gripped > 0.3:
            self._turn, self._gripped = turn + 1, self._at
        self._made[number] = self._at
        command = LeaderCommand(
            number,
            self._turn,
            True,
            {"pan": number * PER_VALUE},
            self._at - CLOCKS_APART_S,
            self._told,
            self._at - self._told_at,
        )
        self.found.sent += 1
        at, draw, weather = self._at + self._way(), self._random, self._weather
        if weather.faults and self._at > self._outage[1] + OUTAGE_EVERY_S:
            longest = draw.choice((SHORT_OUTAGE_S, OUTAGE_MAX_S))
            self._outage = (self._at, self._at + draw.uniform(0.0, longest))
            self._flush = self._outage[1] + self._way()
            for again in range(REPLAYED):
                # What was recorded before comes again when the link is back.
                self._put(self._outage[1] + self._way() + again / 1000, "arrive", command)
        if draw.random() < weather.loss:
            return
        if weather.faults and draw.random() < LATE:
            at += draw.uniform(0.0, LATE_MAX_S)
        if self._outage[0] <= self._at < self._outage[1]:
            # All that queued comes at once, in its order.
            self._flush += IN_ORDER_S
            at = max(at, self._flush)
        self._put(at, "arrive", command)
        if weather.faults and draw.random() < DOUBLED:
            self._put(at + draw.uniform(0.0, 0.1), "arrive", command)

    def _arrive(self, command: LeaderCommand) -> None:
        self._arrived.setdefault(command.seq, self._at)
        self._lead.take(command, self._at)
        facts = self._lead.facts()
        if self._random.random() >= self._weather.loss and not self._outage[0] <= self._at < self._outage[1]:
            self._put(self._at + self._way(), "answer", (facts["now"], facts["state"], facts["turn"]))

    def _answered(self, told: float, state: str, turn: int) -> None:
        if told > self._told:
            self._told, self._told_at, self._state = told, self._at, (state, turn)

    def _beat(self) -> None:
        action = self._policy.act(self._joints)
        if not isinstance(action, dict) or self._lead.state != "led":
            return
        self._joints |= action
        number = round(action["pan"] / PER_VALUE)
        if number == self._last or number not in self._arrived:
            return
        self._last = number
        self.found.carried += 1
        age = self._arrived[number] - self._made[number]
        self.found.oldest_s = max(self.found.oldest_s, age)
        if age > self._weather.one_way_s + JITTER_S + SPARE_S:
            self.found.stale += 1
