"""Age of the newest picture that an operator of a far lead sees."""

from __future__ import annotations

import hashlib
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from strands_robots.policies.freshness import PAUSE_MAX_S, Least

REMEMBERED = 64
"""Pictures that are compared with a new one: a camera that shows a loop of its buffer shows nothing new."""


class PictureAge:
    """Age of the newest changed picture of one camera.

    Of several cameras the greatest counts.

    A picture that came before, byte for byte, is no new one, so a camera that freezes ages while it goes on to send.
    Thread-safe.

    Args:
        now: monotonic seconds.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._known: deque[bytes] = deque(maxlen=REMEMBERED)
        self._shortest = Least()
        self._flowed = 0.0
        self._taken = self._arrived = now()

    @property
    def age_s(self) -> float:
        """Seconds since the newest changed picture; before the first, since this was made."""
        with self._lock:
            return max(self._now() - self._taken, 0.0)

    def came(self, picture: Any, taken: float | None = None) -> bool:
        """Note a picture that has arrived now; return True for a new one.

        Args:
            picture: its bytes, encoded or not; an array must be contiguous.
            taken: when it was taken, in seconds of the camera's clock, which need not be set. What it took beyond the
                shortest way of the last 10 s of pictures counts as age. None where that is not known.
        """
        mark = hashlib.blake2b(memoryview(picture), digest_size=16).digest()
        with self._lock:
            now = self._now()
            # An outage must not make its backlog the measure.
            self._flowed += min(now - self._arrived, PAUSE_MAX_S)
            self._arrived = now
            late = 0.0 if taken is None else now - taken - self._shortest.add(self._flowed, now - taken)
            if mark in self._known:
                return False
            self._known.append(mark)
            self._taken = max(self._taken, now - late)
            return True
