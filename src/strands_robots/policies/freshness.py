"""Ages of a leader's commands at their arrival.

A command states when it was made, by its sender's clock. The smallest difference to the moment of its arrival, over
ten seconds, is the difference of the clocks and the link's shortest way together; what a command took beyond that is
known exactly. The way itself is half of the shortest round trip: each command repeats the newest moment of the
robot's clock that its sender was told, and says how long ago that was.

The first commands have nothing to be compared with, and may all have queued. Until the link has been measured for
:data:`MEASURED_S`, the whole round trip stands for a command's age, which is never more than that.
"""

from __future__ import annotations

import math
from collections import deque

WINDOW_S = 10.0
"""Seconds of arrivals of which the shortest way is taken."""

PAUSE_MAX_S = 0.25
"""Longest pause between two arrivals that counts as time: an outage must not make its backlog the measure."""

ONE_WAY_MAX_S = 0.25
"""Longest way of a link over which a robot is led."""

SPARE_S = 0.1
"""Seconds that a command may be older than the link's shortest way."""

MEASURED_S = SPARE_S
"""Seconds of arrivals after which the link is measured."""

BACKWARDS_S = 0.01
"""A round trip that took less than none by so much: one of the clocks stood still, as in a suspended computer."""


class Least:
    """Least of the values of the last :data:`WINDOW_S`, by the time of arrivals."""

    def __init__(self) -> None:
        self._rising: deque[tuple[float, float]] = deque()

    def add(self, at: float, value: float) -> float:
        """Add a value; return the least."""
        while self._rising and self._rising[-1][1] >= value:
            self._rising.pop()
        self._rising.append((at, value))
        while self._rising[0][0] < at - WINDOW_S:
            self._rising.popleft()
        return self._rising[0][1]


class CommandAges:
    """Judges the age of each command of one leader. All times are seconds.

    Args:
        spare_s: a command may be so much older than the shortest way; a leader of the robot's own process may pause
            longer than one behind a network.
    """

    def __init__(self, spare_s: float | None = None) -> None:
        self._spare_s = SPARE_S if spare_s is None else spare_s
        self._begin()

    def _begin(self) -> None:
        """Forget what is known of the link."""
        self._flowed = 0.0
        self._received: float | None = None
        self._ways, self._trips = Least(), Least()
        self._one_way = 0.0

    @property
    def one_way_s(self) -> float:
        """The link's shortest way, 0 before the first command."""
        return self._one_way

    @property
    def limit_s(self) -> float:
        """Greatest age of a command, and longest silence before a hold."""
        return min(self._one_way, ONE_WAY_MAX_S) + self._spare_s

    def age_s(self, made: float, received: float, told: float, told_ago_s: float) -> float:
        """Return how old a command is at its arrival; infinite where that is not known.

        Args:
            made: the sender's clock when it was made.
            received: the robot's clock at its arrival.
            told: the robot's clock as the sender was told it last.
            told_ago_s: time since then at the sender when the command was made, 0 or more.
        """
        trip = received - told - told_ago_s
        if trip < -BACKWARDS_S:
            self._begin()
            return math.inf
        if self._received is not None:
            self._flowed += min(max(received - self._received, 0.0), PAUSE_MAX_S)
        self._received = received
        beyond = received - made
        beyond -= self._ways.add(self._flowed, beyond)
        self._one_way = max(self._trips.add(self._flowed, trip), 0.0) / 2
        if self._flowed < MEASURED_S and trip > SPARE_S:
            return math.inf
        return self._one_way + beyond
