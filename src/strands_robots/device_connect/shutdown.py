"""The orderly end of a program: StopSignal, and the deadline of a thread.

Importing this module needs no extra.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any, Self

LOOP_JOIN_TIMEOUT_S = 5.0
"""Seconds that a failed or stopped bring-up, or a client, waits for its thread to end."""


class StopSignal:
    """Context in which the first SIGINT or SIGTERM ends :meth:`wait`.

    A second signal acts as before. Signal handlers exist in the main thread only; elsewhere entering raises
    ``ValueError``.

    ::

        with StopSignal() as stop:
            stop.wait()
            robot.halt("the operator ended the program")
            stop_device_connect(runtime)
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self._received = threading.Event()
        self._previous: dict[signal.Signals, Any] = {}
        self.number: int | None = None

    def __enter__(self) -> Self:
        for each in self.SIGNALS:
            self._previous[each] = signal.signal(each, self._on_signal)
        return self

    def __exit__(self, *_exception: object) -> None:
        self._restore()

    def wait(self, within: float | None = None) -> int | None:
        """Return the number of the signal, or None after ``within`` seconds."""
        # On some platforms a signal handler does not interrupt an untimed wait on a lock.
        left = within
        while not self._received.wait(0.2 if left is None else min(0.2, max(left, 0))):
            if left is not None:
                left -= 0.2
                if left <= 0:
                    return None
        return self.number

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        self._restore()
        self._received.set()

    def _restore(self) -> None:
        previous, self._previous = self._previous, {}
        for each, handler in previous.items():
            signal.signal(each, handler)
