"""Rate limiter of both networks: a token bucket for each key."""

from __future__ import annotations

import time
from collections.abc import Callable


class RateLimiter:
    """Admits ``hz`` a second for each key.

    Args:
        hz: the steady rate; 0 or less admits none.
        burst: how many are admitted at once after a pause. With 1.5 a source at just this rate loses nothing, and a
            fast one is thinned out.
        at_start: the same for a key that is new; ``burst`` where left out.
        clock: seconds, steady.
    """

    def __init__(
        self,
        hz: float,
        *,
        burst: float = 1.5,
        at_start: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._hz = hz
        self._burst = burst
        self._at_start = burst if at_start is None else at_start
        self._clock = clock
        self._tokens: dict[str, tuple[float, float]] = {}

    def admit(self, key: str = "") -> bool:
        """Return True when one more of ``key`` may go now."""
        if self._hz <= 0:
            return False
        now = self._clock()
        tokens, since = self._tokens.get(key, (self._at_start, now))
        tokens = min(self._burst, tokens + (now - since) * self._hz)
        admitted = tokens >= 1.0
        self._tokens[key] = (tokens - 1.0 if admitted else tokens, now)
        return admitted

    def forget(self, key: str = "") -> None:
        """Start over with ``key``."""
        self._tokens.pop(key, None)
