"""Moments at which emergency stops were pressed."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

PRESSES_MAX = 64
"""Presses remembered, so that a stop that goes on under its id keeps the time of its press."""


@dataclass(frozen=True, slots=True)
class Press:
    """The moment of a press, in monotonic and in wall-clock seconds."""

    at: float
    wall: float


class Presses:
    """The latest presses by the ids of their stops; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._presses: dict[str, Press] = {}

    def note(self, estop_id: str) -> Press:
        """Record the press of a stop, once; every later call returns the same moment."""
        with self._lock:
            press = self._presses.setdefault(estop_id, Press(time.monotonic(), time.time()))
            while len(self._presses) > PRESSES_MAX:
                del self._presses[next(iter(self._presses))]
        return press
