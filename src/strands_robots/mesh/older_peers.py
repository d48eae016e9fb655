"""Pacing towards peers of the 0.5 releases.

Such a peer drops, at its Zenoh ingress, a command that comes less than 50 ms after the one before it on the same link,
and a message on a safety topic less than 500 ms after. It declares no liveliness token, by which the registry knows it.
Without such a peer nothing waits here.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager

logger = logging.getLogger(__name__)

COMMANDS_S = 0.06
"""Between two commands on one link, and between two broadcasts: 0.5.3 keeps the same between its own."""

SAFETY_S = 0.6
"""Between two messages on a safety topic."""

ASK_AGAIN_S = 0.25
"""After which an unanswered stop or read is asked again, under a fresh turn."""

SAFETY = "safety"


class Pacer:
    """Keeps the messages of one kind apart; thread-safe.

    The peers of a process share it, as they share the link.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._changed = threading.Condition()
        self._last: dict[str, float] = {}
        self._urgent: Counter[str] = Counter()

    def note(self, kind: str) -> None:
        """Note a message that does not wait."""
        self._last[kind] = self._clock()

    @contextmanager
    def turn(self, kind: str, gap_s: float, *, first: bool = False) -> Iterator[None]:
        """Wait until ``gap_s`` after the last message; ``first`` overtakes others."""
        with self._changed:
            self._urgent[kind] += first
            try:
                while (left := self._left(kind, gap_s)) > 0 or (self._urgent[kind] and not first):
                    self._changed.wait(left if left > 0 else None)
            finally:
                self._urgent[kind] -= first
                self._changed.notify_all()
            try:
                yield
            finally:
                # After the put: a thread that is held up before it must not bring the next message closer.
                self._last[kind] = self._clock()

    def _left(self, kind: str, gap_s: float) -> float:
        return self._last.get(kind, -math.inf) + gap_s - self._clock()


class Closings:
    """Publishes the closing envelopes of e-stops late, in the background.

    Such a peer locks on that envelope alone. One whose ``status`` says that it is not locked is named.

    Args:
        name: of the threads.
        status: asks a peer for its status; returns the result, or None.
    """

    def __init__(self, name: str, status: Callable[[str], object]) -> None:
        self._name = name
        self._status = status
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def begin(self, publish: Callable[[], None], peers: Iterable[str]) -> None:
        """Publish, which waits for its turn, then ask the peers; return at once."""

        def run() -> None:
            publish()
            for peer in peers:
                result = None if self._over.is_set() else self._status(peer)
                if isinstance(result, Mapping) and result.get("locked") is False:
                    logger.critical("%s is NOT LOCKED after the emergency stop: it may be started again.", peer)

        thread = threading.Thread(target=run, name=self._name, daemon=True)
        self._threads = [each for each in self._threads if each.is_alive()] + [thread]
        thread.start()

    def close(self, timeout: float) -> None:
        """Wait for envelopes that are not out yet, at most ``timeout`` seconds."""
        self._over.set()
        deadline = time.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
