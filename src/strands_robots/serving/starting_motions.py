"""Motions of one robot that were admitted and have not begun or been refused.

A detail of the control lease, which calls every method with its own lock held.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

START_WAIT_S = 1.0
"""Longest wait of a motion for the start of another caller's, which the robot may yet refuse."""


LOOK_S = 0.02
"""Seconds between two looks whether a motion has begun."""


class StartingMotions:
    """The motions that are about to begin, and those that wait for their start.

    Args:
        changing: the lock of the robot's lease.
    """

    def __init__(self, changing: threading.RLock) -> None:
        self._closed = threading.Condition(changing)
        self._open: dict[object, Callable[[], bool]] = {}
        self._waiting: list[object] = []

    def __bool__(self) -> bool:
        return bool(self._open)

    @property
    def undecided(self) -> bool:
        """True while the robot may yet refuse one of them."""
        return any(not begun() for begun in self._open.values())

    def add(self, motion: object, begun: Callable[[], bool]) -> None:
        """Note a motion that is about to begin, until ``begun`` is true or it is closed."""
        self._open[motion] = begun

    def close(self, motion: object) -> None:
        """Note that it has begun or was refused; who waits looks anew."""
        self._open.pop(motion, None)
        self._closed.notify_all()

    def wait(self, undecided: Callable[[], bool], free: Callable[[], bool]) -> None:
        """Wait for the start of another's motion, in the order of arrival.

        A call that the robot refuses would keep others from it otherwise, again and again.

        Args:
            undecided: whether the motion of another holds the robot, and may yet be refused.
            free: whether nobody holds it.
        """
        if not undecided() and not (self._waiting and free()):
            return
        turn = object()
        self._waiting.append(turn)
        deadline = time.monotonic() + START_WAIT_S
        while not (self._waiting[0] is turn if free() else not undecided()) and time.monotonic() < deadline:
            # A motion that begins tells nobody.
            self._closed.wait(LOOK_S)
        self._waiting.remove(turn)
        self._closed.notify_all()
