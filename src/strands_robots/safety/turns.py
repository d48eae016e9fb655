"""Turns of Python's interpreter, short while a stop may come or a robot moves."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

SWITCH_S = 0.0005
"""Longest time in seconds that a busy Python thread may keep the interpreter from the threads of a stop; Python's own
default is ten times that, and a stop wakes up to three threads on either side."""


class ShortTurns:
    """Keeps the interpreter's turns short while anyone needs that."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._default_s = SWITCH_S

    def begin(self) -> Callable[[], None]:
        """Have busy threads give the interpreter up early; return the end of it.

        Turns are as before once every caller has ended it; to end it twice is harmless.
        """
        with self._lock:
            if not self._users:
                self._default_s = sys.getswitchinterval()
                sys.setswitchinterval(min(self._default_s, SWITCH_S))
            self._users += 1
        left = [None]

        def end() -> None:
            with self._lock:
                if not left:
                    return
                left.clear()
                self._users -= 1
                if not self._users:
                    sys.setswitchinterval(self._default_s)

        return end


shorten_turns = ShortTurns().begin
"""Shortens the turns of this process; see :meth:`ShortTurns.begin`."""
