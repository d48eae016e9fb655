"""Motions of one robot that were admitted and have not begun or been refused."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

START_WAIT_S = 1.0
"""Longest wait of a motion for the start of another caller's, which the robot may yet refuse."""


LOOK_S = 0.02
"""Seconds between two looks whether a motion has begun."""


class Admission:
    """Leave of one motion to begin.

    Args:
        end: is told of the end; nothing is held without it.
    """

    def __init__(self, end: Callable[[Admission, bool], None] | None = None) -> None:
        self._end = end
        self.begun: Callable[[], bool] = lambda: False
        """Whether something moves by it already, while its call has not ended."""

    def close(self, begun: bool = True) -> None:
        """Report that the motion has begun, or with False that it was refused."""
        if self._end is not None:
            self._end(self, begun)


class Admissions:
    """The admissions that are open, and the motions that wait for their end.

    Args:
        changing: the lock of the robot's lease; every method is called with it held.
    """

    def __init__(self, changing: threading.RLock) -> None:
        self._closed = threading.Condition(changing)
        self._open: set[Admission] = set()
        self._waiting: list[object] = []

    def __bool__(self) -> bool:
        return bool(self._open)

    @property
    def undecided(self) -> bool:
        """True while the robot may yet refuse one of them."""
        return any(not each.begun() for each in self._open)

    def add(self, admission: Admission) -> None:
        """Note a motion that is about to begin."""
        self._open.add(admission)

    def close(self, admission: Admission) -> None:
        """Note that it has begun or was refused; who waits looks anew."""
        self._open.discard(admission)
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
