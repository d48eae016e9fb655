"""Settings of Python's interpreter for stops: its turns and its collector."""

from __future__ import annotations

import gc
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

SWITCH_S = 0.0005
"""Longest time in seconds that a busy Python thread may keep the interpreter from the threads of a stop; Python's own
default is ten times that, and a stop wakes up to three threads on either side."""


class _WhileNeeded(ABC):
    """A setting of the interpreter that is another one while anyone needs that."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0

    @abstractmethod
    def _change(self) -> None: ...

    @abstractmethod
    def _restore(self) -> None: ...

    def begin(self) -> Callable[[], None]:
        """Change the setting; return the end of it.

        The setting is as before once every caller has ended it.
        """
        with self._lock:
            if not self._users:
                self._change()
            self._users += 1
        left = [None]

        def end() -> None:
            with self._lock:
                if not left:
                    return
                left.clear()
                self._users -= 1
                if not self._users:
                    self._restore()

        return end


class ShortTurns(_WhileNeeded):
    """Turns of the interpreter in which busy threads give it up early."""

    def __init__(self) -> None:
        super().__init__()
        self._default_s = SWITCH_S

    def _change(self) -> None:
        self._default_s = sys.getswitchinterval()
        self._shorten()

    def _shorten(self) -> None:
        sys.setswitchinterval(min(self._default_s, SWITCH_S))

    def _restore(self) -> None:
        sys.setswitchinterval(self._default_s)

    def suspend(self) -> None:
        """Give the turns their own length while they are short."""
        with self._lock:
            if self._users:
                self._restore()

    def go_on(self) -> None:
        """Make the turns short again if anyone still needs that."""
        with self._lock:
            if self._users:
                self._shorten()


class LongTurns(_WhileNeeded):
    """Turns of their own length in place of short ones.

    A stop of many robots is a few milliseconds of work on several threads. Short turns would cut it into dozens of
    hand-offs, each of which waits for a free core, and save it nothing beside a busy thread.
    """

    def __init__(self, short: ShortTurns) -> None:
        super().__init__()
        self._short = short

    def _change(self) -> None:
        self._short.suspend()

    def _restore(self) -> None:
        self._short.go_on()


class PausedCollector(_WhileNeeded):
    """Garbage collector that waits.

    A whole collection stops all threads of a large process for 0.1 s and more.
    """

    def __init__(self) -> None:
        super().__init__()
        self._enabled = True

    def _change(self) -> None:
        self._enabled = gc.isenabled()
        gc.disable()

    def _restore(self) -> None:
        if self._enabled:
            gc.enable()


_SHORT_TURNS = ShortTurns()
_LONG_TURNS = LongTurns(_SHORT_TURNS)
_COLLECTOR = PausedCollector()

shorten_turns = _SHORT_TURNS.begin
"""Shortens the turns of this process."""


def undisturbed(*, many: bool) -> Callable[[], None]:
    """Prepare the interpreter for halts; return the end of it.

    Args:
        many: there are so many halts that turns of their own length are better for them.
    """
    ends = [_COLLECTOR.begin(), *([_LONG_TURNS.begin()] if many else [])]

    def end() -> None:
        for each in ends:
            each()

    return end
