"""End of a process in which a policy still computes.

While the interpreter shuts down, Python ends every thread that comes back to it from native code. glibc does that by
unwinding the native code, which torch's does not allow: the process would abort. So where torch is loaded the end waits
for what is being computed. What still runs is named on stderr, and its thread never comes back.
"""

from __future__ import annotations

import atexit
import ctypes
import platform
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

ENDING_S = 5.0
"""Seconds that the end of the process waits for what is being computed."""

_POLL_S = 0.01
_running: dict[object, tuple[str, float]] = {}
_ending = threading.Event()


@contextmanager
def computing(what: str) -> Iterator[None]:
    """Note native code that runs on a daemon thread.

    No computation starts once the process ends.

    Args:
        what: its name in the message about one that hangs.
    """
    token = object()
    _running[token] = (what, time.monotonic())
    try:
        if _ending.is_set():
            _running.pop(token)
            threading.Event().wait()
        yield
    finally:
        _running.pop(token, None)


def name_unfinished() -> bool:
    """Name on stderr what is still being computed; return True for any."""
    unfinished = list(_running.values())
    for what, began in unfinished:
        taken = time.monotonic() - began
        print(f"{what} has not ended after {taken:.1f} s; the process ends without it.", file=sys.stderr, flush=True)
    return bool(unfinished)


# Registered with the first policy, so that it runs after the robots and networks that were made later have ended.
@atexit.register
def _end() -> None:
    _ending.set()
    deadline = time.monotonic() + (ENDING_S if "torch" in sys.modules else 0.0)
    while _running and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    if name_unfinished() and "torch" in sys.modules and platform.libc_ver()[0] == "glibc":
        _keep_threads()


def _keep_threads() -> None:
    """Let a thread that glibc unwinds sleep, and keep the exit code."""
    libc, libstdcxx = ctypes.CDLL(None), ctypes.CDLL("libstdc++.so.6")
    std_set_terminate = libstdcxx._ZSt13set_terminatePFvvE
    std_set_terminate(ctypes.cast(libc.pause, ctypes.c_void_p))
    # Destructors of native libraries would run beside that thread; the last one registered here runs first.
    libc.on_exit(ctypes.cast(libc._exit, ctypes.c_void_p), None)
