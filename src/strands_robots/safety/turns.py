"""Turns of Python's interpreter, short while emergency stops may come or go."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

SWITCH_S = 0.0005
"""Longest time in seconds that a busy Python thread may keep the interpreter from the threads of a stop; Python's own
default is ten times that, and a stop wakes up to three threads on either side."""

_lock = threading.Lock()
_users = 0
_default_s = SWITCH_S


def shorten_turns() -> Callable[[], None]:
    """Have busy threads give the interpreter up early; return the end of it.

    Turns are as before once every caller has ended it; to end it twice is harmless.
    """
    global _users, _default_s  # noqa: PLW0603 - the interval is the process's own
    with _lock:
        if not _users:
            _default_s = sys.getswitchinterval()
            sys.setswitchinterval(min(_default_s, SWITCH_S))
        _users += 1
    left = [None]

    def end() -> None:
        global _users  # noqa: PLW0603 - as above
        with _lock:
            if not left:
                return
            left.clear()
            _users -= 1
            if not _users:
                sys.setswitchinterval(_default_s)

    return end
