"""Newest values of a served robot, each read by a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from lerobot_robot_strands.ending import RobotEndedError
from strands_robots.errors import RefusalError

Value = TypeVar("Value")

FIRST_S = 15.0
"""Longest wait for the first value: the first picture of a simulation compiles its renderer."""

AGAIN_S = 0.1
"""Pause after a failure."""


class Newest(Generic[Value]):
    """Newest value of something that is read again and again. Who takes it does not wait while it is fresh.

    Args:
        what: names it in an error, such as ``arm-1: camera front``.
        read: returns the value and its age in seconds when it was answered; may raise :class:`RefusalError`.
        hz: reads a second, above 0.
        max_age_s: age beyond which the value is refused.
    """

    def __init__(self, what: str, read: Callable[[], tuple[Value, float]], hz: float, max_age_s: float) -> None:
        self._what, self._read, self._period_s, self._max_age_s = what, read, 1 / hz, max_age_s
        self._over, self._changed = threading.Event(), threading.Condition()
        self._newest: tuple[Value, float] | None = None
        self._problem = ""
        self._thread = threading.Thread(target=self._run, name=f"strands {what}", daemon=True)
        self._thread.start()

    def first(self) -> Value:
        """Return the first value, waited for.

        Raises:
            RobotEndedError: none has come.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, FIRST_S)
        return self.take()

    def take(self) -> Value:
        """Return the newest value.

        One that is too old is waited for, once and for ``max_age_s``: LeRobot's video encoder may have kept every
        thread of this process from running.

        Raises:
            RobotEndedError: it is too old.
        """
        if self.age_s > self._max_age_s:
            with self._changed:
                self._changed.wait_for(lambda: self.age_s <= self._max_age_s, self._max_age_s)
        newest, age_s = self._newest, self.age_s
        if newest is None:
            raise RobotEndedError(f"strands: {self._what} has not been read{self._because}.")
        if age_s > self._max_age_s:
            bound = f"{1000 * age_s:.0f} ms old and may be {1000 * self._max_age_s:.0f}"
            raise RobotEndedError(f"strands: {self._what} is {bound}{self._because}.")
        return newest[0]

    @property
    def age_s(self) -> float:
        """Age of the newest value in seconds; infinite without one."""
        newest = self._newest
        return float("inf") if newest is None else time.monotonic() - newest[1]

    def close(self) -> None:
        """Read no more."""
        self._over.set()
        self._thread.join()

    @property
    def _because(self) -> str:
        return f": {self._problem}" if self._problem else ""

    def _run(self) -> None:
        due = time.monotonic()
        while not self._over.is_set():
            asked = time.monotonic()
            try:
                value, age_s = self._read()
            except (RefusalError, ValueError) as failed:
                self._problem = str(failed).rstrip(".")
                self._over.wait(AGAIN_S)
                continue
            # It was read no earlier than this, however long the answer took.
            with self._changed:
                self._newest, self._problem = (value, asked - age_s), ""
                self._changed.notify_all()
            due = max(due + self._period_s, time.monotonic() - self._period_s)
            self._over.wait(max(0.0, due - time.monotonic()))
