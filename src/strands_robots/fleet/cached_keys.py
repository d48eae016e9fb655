"""Enrolled keys as read lately, for callers that ask many times a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

AGAIN_S = 2.0
"""Seconds for which the keys count that were read last."""

Keys = Mapping[str, bytes] | None
"""Keys by robot; None where they cannot be used, so that nothing can be proven."""


class CachedKeys:
    """Enrolled keys of a network, read again when they are needed.

    Args:
        load: reads them.
    """

    def __init__(self, load: Callable[[], Keys]) -> None:
        self._load = load
        self._keys: Keys = None
        self._read_at = float("-inf")

    def read(self) -> Keys:
        """Return the keys, at most :data:`AGAIN_S` old."""
        now = time.monotonic()
        if now - self._read_at >= AGAIN_S:
            # The time last: another thread must not take the keys of before for these.
            self._keys = self._load()
            self._read_at = now
        return self._keys
