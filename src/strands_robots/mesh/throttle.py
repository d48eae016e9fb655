"""Bounds on repetition: audit events, log lines, replays."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from strands_robots.audit import queue_safety_event

AuditSink = Callable[[str, str, dict[str, Any]], None]
"""Event type, peer id, payload; returns at once and never raises."""

BURST = 5
WINDOW_S = 1.0
KINDS_MAX = 1024


@dataclass(slots=True)
class _Window:
    since: float
    written: int = 0
    left_out: int = 0


class AuditThrottle:
    """Writes the safety events of one peer to ``sink``; thread-safe.

    A hostile peer can make the mesh refuse a thousand messages a second. Each kind of refusal from each peer is
    written :data:`BURST` times in :data:`WINDOW_S`, and the next record states how many were left out.
    """

    def __init__(
        self, peer_id: str, sink: AuditSink = queue_safety_event, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._peer = peer_id
        self._sink = sink
        self._clock = clock
        self._windows: dict[tuple[str, str], _Window] = {}
        self._lock = threading.Lock()

    def __call__(self, event: str, about: str = "", **payload: Any) -> None:
        """Record ``event``, which concerns the peer ``about``; in a flood, some of them."""
        about = about[:128]
        left_out = self._admit((event, about))
        if left_out is None:
            return
        if left_out:
            payload["left_out_before"] = left_out
        if about:
            payload.setdefault("about", about)
        self._sink(event, self._peer, payload)

    def always(self, event: str, **payload: Any) -> None:
        """Record an event that is never left out, such as a stop."""
        self._sink(event, self._peer, payload)

    def close(self) -> None:
        """Record the counts of events left out since the last of their kind."""
        with self._lock:
            counts = {kind: window.left_out for kind, window in self._windows.items() if window.left_out}
            self._windows.clear()
        for (event, about), left_out in counts.items():
            self._sink(event, self._peer, {"about": about, "left_out": left_out})

    def _admit(self, kind: tuple[str, str]) -> int | None:
        now = self._clock()
        with self._lock:
            window = self._windows.get(kind)
            if window is None:
                if len(self._windows) >= KINDS_MAX:
                    # A peer that invents names shares one window with all the others that do.
                    kind = (kind[0], "")
                window = self._windows.setdefault(kind, _Window(now))
            left_out = 0
            if now - window.since >= WINDOW_S:
                left_out, window.left_out, window.written, window.since = window.left_out, 0, 0, now
            if window.written >= BURST:
                window.left_out += 1
                return None
            window.written += 1
            return left_out


class TroubleLog:
    """Logs the trouble of each subject once, until it changes or ends."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._kinds: dict[str, str] = {}

    def note(self, subject: str, kind: str, message: str, *args: object, level: int = logging.WARNING) -> None:
        """Log ``message`` where ``kind`` is new for ``subject``; empty is no trouble."""
        if kind and kind != self._kinds.get(subject):
            self._logger.log(level, message, *args)
        self._kinds[subject] = kind


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
