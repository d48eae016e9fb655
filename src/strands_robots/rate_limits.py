"""Limits on events in a window of time. No lock is shared between two limits."""

from __future__ import annotations

import math

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
            del self._keys[next(iter(self._keys))]
        self._all = (self._all[0], self._all[1] + 1) if now - self._all[0] < self._window_s else (now, 1)
        return max(0, count - int(self._each)) if over else 0

    def _pool(self, key: str) -> str:
        return key if not self._pooled or key in self._keys or len(self._keys) < KEYS_MAX else ""
