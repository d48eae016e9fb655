"""Where emergency stops wait for the lane's thread: bounded, fair between sources, newest first.

A flood of forged stops must not stand before a true one. Sources share a fixed number of trays by a keyed hash;
trays are served in turn, one message each, and in a tray the newest message comes first. What overflows a tray is
its oldest message; a controller repeats its stop, so a true one is heard again.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from dataclasses import dataclass

TRAYS = 64
TRAY_MAX = 16


@dataclass(frozen=True, slots=True)
class Heard:
    """One event from a link: its name, who it says sent it, its bytes, and our monotonic seconds at receipt."""

    event: str
    source: str
    payload: bytes
    at: float


class Intake:
    """A queue between the threads of the links and the lane's. No method blocks but :meth:`take`."""

    def __init__(self) -> None:
        self._salt = secrets.randbits(62)
        self._trays: list[deque[Heard]] = [deque(maxlen=TRAY_MAX) for _ in range(TRAYS)]
        self._waiting = threading.Event()
        self._turn = 0
        self._closed = False

    def offer(self, event: str, source: str, payload: bytes, *, urgent: bool = True) -> None:
        """Put an event in; called by the links' threads. What is not urgent comes last, and goes first when full."""
        heard = Heard(event, source, payload, time.monotonic())
        tray = self._trays[hash((self._salt, source)) % TRAYS]
        # Appending to a deque and setting an event are atomic; no lock is shared with the lane's thread.
        if urgent:
            tray.append(heard)
        elif len(tray) < TRAY_MAX // 2:
            tray.appendleft(heard)
        self._waiting.set()

    def take(self) -> Heard | None:
        """The next event, waiting for one; None once closed and empty."""
        while True:
            for _ in range(TRAYS):
                self._turn = (self._turn + 1) % TRAYS
                tray = self._trays[self._turn]
                if tray:
                    return tray.pop()
            if self._closed:
                return None
            self._waiting.wait()
            self._waiting.clear()
            # What was offered between the look and the clearing is found by the next look; what comes later sets it.

    def close(self) -> None:
        """Let :meth:`take` return None when nothing is left."""
        self._closed = True
        self._waiting.set()
