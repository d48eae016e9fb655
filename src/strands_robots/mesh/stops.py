"""Stops in line: none is refused, and those that wait are carried out together.

A halt of a slow robot may last a second, and a flood brings a thousand stops meanwhile. Every stop that arrives while
one is carried out is served by the next, which begins after it and whose verdict is therefore true for all of them.
What is kept of a stop is who asked; one robot of a world is a line of its own. The answers are given on another lane:
thousands of them hold up no halt.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterable

from strands_robots.mesh.executor import Lane

logger = logging.getLogger(__name__)

Asker = tuple[str, str]
"""Sender and turn."""

Tell = Callable[[list[Asker]], None]
"""Answers those who asked."""

Halt = Callable[[str], Tell]
"""Halts the robot of a name, or everything for the empty one; what is returned tells the verdict."""

EACH = 256
MOST = 4096


class Stops:
    """Stops without an answer, by the robot that they name: in line, or carried out and about to be answered.

    Args:
        lane: whose worker halts. One job of it at a time is ours, one halt each, so that others come between.
        answers: whose worker tells the verdicts.
    """

    def __init__(self, lane: Lane, answers: Lane, halt: Halt) -> None:
        self._lane = lane
        self._answers = answers
        self._halt = halt
        self._waiting: dict[str, dict[Asker, None]] = {}
        self._held: Counter[str] = Counter()
        self._halting = False
        self._lock = threading.Lock()
        self.unanswered = 0

    def add(self, robot: str, sender: str, turn: str) -> bool:
        """Take a stop of a robot that there is, or of all for the empty name; False only when the lane is closed.

        A sender beyond 256 stops without an answer, and the one with the most in line beyond 4096 in all, loses the
        answer to its oldest. The halt that it asked for comes all the same.
        """
        with self._lock:
            askers = self._waiting.setdefault(robot, {})
            if (sender, turn) not in askers:
                askers[sender, turn] = None
                self._held[sender] += 1
            if self._held[sender] > EACH:
                self._shed(sender)
            elif self._held.total() > MOST:
                in_line = Counter(who for each in self._waiting.values() for who, _ in each)
                self._shed(in_line.most_common(1)[0][0])
            begin, self._halting = not self._halting, True
        return not begin or self._lane.submit(self._run)

    def __len__(self) -> int:
        return self._held.total()

    def _run(self) -> None:
        with self._lock:
            robot = next(iter(self._waiting))
            askers = list(self._waiting.pop(robot))
        told = False
        try:
            tell = self._halt(robot)
            told = self._answers.submit(lambda: self._answer(tell, askers))
        except Exception:
            logger.exception("A stop failed.")  # and the next one is carried out
        with self._lock:
            if not told:
                self._release(askers)
                self.unanswered += len(askers)
            self._halting = bool(self._waiting)
            more = self._halting
        if more:
            self._lane.submit(self._run)

    def _answer(self, tell: Tell, askers: list[Asker]) -> None:
        try:
            tell(askers)
        finally:
            with self._lock:
                self._release(askers)

    def _release(self, askers: Iterable[Asker]) -> None:
        self._held.subtract(sender for sender, _ in askers)
        self._held = +self._held

    def _shed(self, sender: str) -> None:
        for askers in self._waiting.values():
            oldest = next((asker for asker in askers if asker[0] == sender), None)
            if oldest is not None:
                del askers[oldest]
                self._release([oldest])
                self.unanswered += 1
                return
