"""Comparison of clocks, so that a late stop is told from a wrong clock."""

from __future__ import annotations

from dataclasses import dataclass

SOURCES_MAX = 64
KEPT_S = 600.0
"""A comparison older than this gives way to a newer one: clocks drift, and are set."""


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One question and its answer, by which NTP compares clocks.

    All times are wall-clock seconds (RFC 5905, section 8).

    Attributes:
        sent: of the question, by this clock.
        received_there: of the question, by the other clock.
        answered_there: of the answer's sending, by the other clock.
        received: of the answer, by this clock.
    """

    sent: float
    received_there: float
    answered_there: float
    received: float

    @property
    def ahead_s(self) -> float:
        """Lead of the other clock in s, exact to half of :attr:`on_network_s`."""
        return ((self.received_there - self.sent) + (self.answered_there - self.received)) / 2

    @property
    def on_network_s(self) -> float:
        """Seconds that question and answer were on the network."""
        return (self.received - self.sent) - (self.answered_there - self.received_there)


class ObservedClocks:
    """Lead of this clock over each sender's, from its messages alone.

    The message that took least time on the network shows the difference best, so the smallest one counts. It includes
    the least time that a message takes, milliseconds on a network of machines.
    """

    def __init__(self) -> None:
        self._smallest: dict[str, tuple[float, float]] = {}

    def note(self, source: str, difference_s: float, now: float) -> float | None:
        """Record one message; return what the messages before it showed, or None.

        Args:
            source: the sender, whose name was checked.
            difference_s: this clock at its receipt less the sender's at its sending.
            now: monotonic seconds.
        """
        known = self._smallest.get(source)
        if known is None or difference_s < known[0] or now - known[1] > KEPT_S:
            self._smallest[source] = (difference_s, now)
            while len(self._smallest) > SOURCES_MAX:
                self._smallest.pop(next(iter(self._smallest)), None)
        return None if known is None else known[0]


def seconds_of(t: object) -> float | None:
    """Return a time of a message: a finite number that a float holds, else None."""
    if isinstance(t, bool) or not isinstance(t, int | float) or not abs(t) < 1e18:
        return None
    return float(t)
