"""Count of stops that were answered without being carried out one by one."""

from __future__ import annotations

import threading
from typing import Any

SOURCES_NAMED = 16


class StopCount:
    """Stops of a flood since the last record of them; thread-safe.

    Args:
        every_s: seconds between two records.
    """

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._counting = threading.Lock()
        self._stops = 0
        self._sources: set[str] = set()
        self._due_at = float("-inf")

    def add(self, source: str) -> None:
        """Count one stop of ``source``."""
        with self._counting:
            self._stops += 1
            if len(self._sources) < SOURCES_NAMED:
                self._sources.add(source[:256])

    def take(self, now: float) -> dict[str, Any] | None:
        """Return the facts to record, and count anew; None when nothing is due."""
        with self._counting:
            if not self._stops or now < self._due_at:
                return None
            facts = {"stops": self._stops, "some_sources": sorted(self._sources)}
            self._stops, self._sources, self._due_at = 0, set(), now + self._every_s
            return facts
