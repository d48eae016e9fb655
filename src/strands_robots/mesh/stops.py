"""Stops in line: none is refused, and those that wait are carried out together.

A halt of a slow robot may last a second, and a flood brings a thousand stops meanwhile. Every stop that arrives while
one is carried out is served by the next, which begins after it and whose verdict is therefore true for all of them.
What is kept of a stop is who asked; one robot of a world is a line of its own.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable

from strands_robots.mesh.executor import Lane

logger = logging.getLogger(__name__)

Asker = tuple[str, str]
"""Sender and turn."""

Halt = Callable[[str, list[Asker]], None]
"""Halts the robot of a name, or everything for the empty one, and answers those who asked."""

EACH = 256
MOST = 4096


class Stops:
    """Stops that wait, by the robot that they name.

    Args:
        lane: whose worker halts. One job of it at a time is ours, one halt each, so that others come between.
    """

    def __init__(self, lane: Lane, halt: Halt) -> None:
        self._lane = lane
        self._halt = halt
        self._waiting: dict[str, dict[Asker, None]] = {}
        self._held: Counter[str] = Counter()
        self._halting = False
        self._lock = threading.Lock()
        self.unanswered = 0

    def add(self, robot: str, sender: str, turn: str) -> bool:
        """Take a stop; False only when the lane is closed.

        A sender beyond 256 waiting stops, and the one with the most of them beyond 4096 in all, loses the answer to its
        oldest. The halt that it asked for comes all the same, unless it named one robot and nobody else asks for that.
        """
        with self._lock:
            askers = self._waiting.setdefault(robot, {})
            if (sender, turn) not in askers:
                askers[sender, turn] = None
                self._held[sender] += 1
            if self._held[sender] > EACH:
                self._shed(sender)
            elif self._held.total() > MOST:
                self._shed(self._held.most_common(1)[0][0])
            begin, self._halting = not self._halting, True
        return not begin or self._lane.submit(self._run)

    def __len__(self) -> int:
        return self._held.total()

    def _run(self) -> None:
        with self._lock:
            robot = next(iter(self._waiting))
            askers = list(self._waiting.pop(robot))
            self._held.subtract(sender for sender, _ in askers)
            self._held = +self._held
        try:
            self._halt(robot, askers)
        except Exception:
            logger.exception("A stop failed.")  # and the next one is carried out
        with self._lock:
            self._halting = bool(self._waiting)
            more = self._halting
        if more:
            self._lane.submit(self._run)

    def _shed(self, sender: str) -> None:
        for robot, askers in self._waiting.items():
            oldest = next((asker for asker in askers if asker[0] == sender), None)
            if oldest is None:
                continue
            del askers[oldest]
            self._held[sender] -= 1
            self.unanswered += 1
            if robot and not askers:
                del self._waiting[robot]
            return
