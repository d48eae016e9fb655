"""Check-in: a robot stops when its last safety controller falls silent.

Both networks carry it: Device Connect as the event ``safetyCheckIn`` of the controller, the mesh on
``strands/P/checkin``. Pure: times come in (monotonic seconds), decisions go out. Off while the timeout is 0.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.safety.orders import StopRules
from strands_robots.safety.statements import Purpose

CONTROLLERS_MAX = 64
SOURCES_MAX = 256
AGE_S = 60.0
"""Largest difference in seconds between a signed check-in's clock and ours."""


class CheckInRules:
    """Rules by which a check-in counts: those of a stop, and each signed one once.

    Args:
        stops: by which the controller's stops count.
        clock: wall-clock seconds.
    """

    def __init__(self, stops: StopRules, clock: Callable[[], float] = time.time) -> None:
        self._stops = stops
        self._clock = clock
        self._latest: dict[str, float] = {}

    def refusal(self, source: str, params: Mapping[str, Any]) -> str | None:
        """Return the reason why this check-in does not count, or None."""
        why = self._stops.source_refusal(source) or self._stops.signature_refusal(source, params, Purpose.CHECK_IN)
        t = params.get("t")
        if why is None and self._stops.signed and isinstance(t, int | float):
            # A recorded check-in played again must not keep a robot moving.
            if t <= self._latest.get(source, 0.0) or abs(self._clock() - t) > AGE_S:
                return "it was checked in before, or its clock is a minute off"
            if len(self._latest) < SOURCES_MAX or source in self._latest:
                self._latest[source] = t
        return why


class CheckIn:
    """The last check-in of each controller, and the time that is left.

    The clock runs from the start: a robot that needs a controller and never receives a check-in stops too. After it has
    lapsed once it is at rest until a controller checks in or the robots are free again.
    """

    def __init__(self, timeout_s: float, now: float | None = None) -> None:
        self.timeout_s = timeout_s
        self._last: dict[str, float] = {}
        self._since = time.monotonic() if now is None else now
        self._lapsed = False

    @property
    def on(self) -> bool:
        """True when a live controller is needed."""
        return self.timeout_s > 0

    def record(self, controller: str, now: float) -> None:
        """Record a check-in of ``controller``."""
        if controller not in self._last and len(self._last) >= CONTROLLERS_MAX:
            del self._last[min(self._last, key=self._last.__getitem__)]
        self._last[controller] = now
        self._lapsed = False

    def rearm(self, now: float) -> None:
        """Restart the timeout when the robots are free; forget silent controllers."""
        self._last = {name: at for name, at in self._last.items() if now - at <= self.timeout_s}
        self._since = now
        self._lapsed = False

    def time_left(self, now: float) -> float | None:
        """Return the seconds until the robots stop; None while off, 0 once lapsed."""
        if not self.on:
            return None
        latest = max([self._since, *self._last.values()])
        return 0.0 if self._lapsed else max(0.0, self.timeout_s - (now - latest))

    def lapsed(self, now: float) -> tuple[str, ...] | None:
        """Return, once, the silent controllers after the timeout; else None."""
        if not self.on or self._lapsed or (self.time_left(now) or 0.0) > 0.0:
            return None
        self._lapsed = True
        return tuple(sorted(self._last))

    def fields(self, now: float) -> dict[str, object]:
        """Return the fields of ``getStatus``: timeout, seconds left, check-in ages."""
        left = self.time_left(now)
        return {
            "required": self.on,
            "timeout_s": self.timeout_s,
            "time_left_s": None if left is None else round(left, 3),
            "controllers": {name: round(now - at, 3) for name, at in self._last.items()},
        }
