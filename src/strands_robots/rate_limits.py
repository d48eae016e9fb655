"""Limits on events: a number in a window of time, a steady rate, or once.

No lock is shared between two limits.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Hashable
from contextlib import suppress

KEYS_MAX = 256
"""Keys remembered, so that invented names take no memory."""


class EventBudget:
    """Events of each key, and of all keys, that a window of time admits.

    Without the sum, a flood under invented names would be admitted whole. No lock is taken: two threads that count at
    the same moment may count one.

    Args:
        each: events of one key in a window.
        in_all: events of all keys in a window.
        window_s: its length in seconds; it begins with the first event after the one before.
        pooled: once :data:`KEYS_MAX` keys are known, new ones share one; else the oldest is forgotten.
    """

    def __init__(self, each: float, in_all: float = math.inf, *, window_s: float = 1.0, pooled: bool = False) -> None:
        self._each, self._in_all, self._window_s, self._pooled = each, in_all, window_s, pooled
        self._keys: dict[str, tuple[float, int]] = {}
        self._all = (-math.inf, 0)

    def allows(self, key: str, now: float) -> bool:
        """Return True while one more event of ``key`` is admitted; count nothing."""
        since, count = self._keys.get(self._pool(key), (now, 0))
        if count >= self._each and now - since < self._window_s:
            return False
        since, count = self._all
        return count < self._in_all or now - since >= self._window_s

    def take(self, key: str, now: float) -> bool:
        """Count an event of ``key`` where it is admitted; False where it is not."""
        admitted = self.allows(key, now)
        if admitted:
            self.count(key, now)
        return admitted

    def count(self, key: str, now: float) -> int:
        """Count an event of ``key``; return how many of the window before were too many."""
        key = self._pool(key)
        since, count = self._keys.pop(key, (now, 0))
        over = now - since >= self._window_s
        self._keys[key] = (now, 1) if over else (since, count + 1)
        while len(self._keys) > KEYS_MAX:
            with suppress(RuntimeError, StopIteration):  # another thread counts at this moment
                self._keys.pop(next(iter(self._keys)), None)
        self._all = (self._all[0], self._all[1] + 1) if now - self._all[0] < self._window_s else (now, 1)
        return max(0, count - int(self._each)) if over else 0

    def _pool(self, key: str) -> str:
        return key if not self._pooled or key in self._keys or len(self._keys) < KEYS_MAX else ""


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


class RecentKeys:
    """Recently used keys, bounded by age in seconds and by number; thread-safe.

    Args:
        displace: when it is full the oldest is forgotten; otherwise no new one is first.
    """

    def __init__(
        self, seconds: float, most: int, clock: Callable[[], float] = time.monotonic, *, displace: bool = True
    ) -> None:
        self._seconds = seconds
        self._most = most
        self._clock = clock
        self._displace = displace
        self._used: dict[Hashable, float] = {}
        self._lock = threading.Lock()

    def first(self, key: Hashable) -> bool:
        """Note the use of a key; False when it was used before."""
        now = self._clock()
        with self._lock:
            while self._used and now - next(iter(self._used.values())) > self._seconds:
                del self._used[next(iter(self._used))]
            if key in self._used or (len(self._used) >= self._most and not self._displace):
                return False
            while len(self._used) >= self._most:
                del self._used[next(iter(self._used))]
            self._used[key] = now
            return True
