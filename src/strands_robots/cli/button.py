"""The space bar: each press is an emergency stop, sent before anything else is done about it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection

from strands_robots.safety.controller import Progress, SafetyController, StopReport
from strands_robots.safety.orders import new_epoch

HELD_S = 1.0
"""Presses closer than this are one stop: a key that is held repeats, and a robot tells 64 stops apart, not more."""


class Button:
    """Sends a stop at each press and keeps the latest of what became of it.

    A press during a stop that goes on is part of it. A stop goes on until it has left and nobody who is expected is
    silent: a link that swallows everything looks as if it were up for seconds.

    Args:
        controller: sends.
        expected: who must answer, asked at each press.
        reason: told to the robots.
    """

    def __init__(self, controller: SafetyController, expected: Callable[[], Collection[str]], reason: str) -> None:
        self.progress: Progress | None = None
        self.report: StopReport | None = None
        self.presses = 0
        self._controller, self._expected, self._reason = controller, expected, reason
        self._guard = threading.Lock()
        self._id, self._running, self._last = "", False, float("-inf")
        self._closing = threading.Event()

    @property
    def running(self) -> bool:
        """True while a stop waits for answers."""
        return self._running

    def press(self) -> None:
        """Stop everything; returns at once."""
        now = time.monotonic()
        with self._guard:
            self.presses += 1
            held, self._last = now - self._last < HELD_S, now
            if held and self._running:
                return
            if not (held and self._id):
                self._id = new_epoch()
            self._running = True
            threading.Thread(target=self._stop, args=(self._id,), name="space bar", daemon=True).start()

    def close(self) -> None:
        """Give up a stop that waits for the link."""
        self._closing.set()

    def _stop(self, estop_id: str) -> None:
        while True:
            report = self._controller.stop(
                self._expected(), self._reason, estop_id=estop_id, on_progress=self._note(estop_id)
            )
            open_ = not report.link or bool(report.silent)
            with self._guard:
                if estop_id != self._id:
                    return
                self.report, self._running = report, open_ and not self._closing.is_set()
                if not self._running:
                    # A robot that was resumed meanwhile asks for a stop of another name.
                    self._id = "" if report.refused else self._id
                    return

    def _note(self, estop_id: str) -> Callable[[Progress], None]:
        def note(progress: Progress) -> None:
            if estop_id == self._id:
                self.progress = progress

        return note
