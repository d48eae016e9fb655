"""Sockets of Zenoh's links: closing one waits for no host that is gone.

Zenoh 1.10 sets ``SO_LINGER`` to 10 s on each TCP and TLS link (``TCP_LINGER_TIMEOUT`` of zenoh-link-tcp, fixed when it
is built). Where the other host is gone, Linux then keeps the thread that closes the socket for so long (socket(7)). It
is one of the few threads that all sessions of a process share: with half of a network dead, nothing is received from
the other half for 10 s a link.
"""

from __future__ import annotations

import _thread
import ctypes
import functools
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Any

LINGER = struct.Struct("ii")
"""``struct linger``: on or off, and seconds."""

ZENOHS = LINGER.pack(1, 10)
DESCRIPTORS = Path("/dev/fd")

GATHER_S = 0.1
"""Seconds in which further links come up before their sockets are looked for."""

_due = threading.Lock()
"""Held while a search is due that has not begun."""


def close_in_background() -> None:
    """Have the kernel close Zenoh's links in the background; return at once.

    Call it when a link has come up: Zenoh offers neither an option nor the descriptor of a link. Many links that come
    up together cost one search, on a thread that ends with it.
    """
    if _due.acquire(blocking=False):
        try:
            # Unlike Thread.start, this does not wait for the new thread: it is Zenoh's receiving thread that calls.
            _thread.start_new_thread(_gather, ())
        except RuntimeError:
            # There is no thread to be had now: the next link that comes up tries again. Nothing is logged, because a
            # paused terminal would hold Zenoh's thread.
            _due.release()


def change_links() -> int:
    """Change each link of Zenoh's now; return how many.

    What was sent is still delivered where the other host is there. Only sockets with Zenoh's own ten seconds are
    changed.
    """
    try:
        descriptors = [int(each.name) for each in DESCRIPTORS.iterdir()]
    except OSError:  # no such folder on this system
        return 0
    return sum(map(_in_background, descriptors))


def _gather() -> None:
    time.sleep(GATHER_S)
    _due.release()
    change_links()


def _in_background(descriptor: int) -> bool:
    """Change one descriptor; False where it is no link of Zenoh's, or closed."""
    # A socket object of Python's would change the socket: it applies the process's default timeout to it.
    libc, option = _libc(), (socket.SOL_SOCKET, socket.SO_LINGER)
    value, length = ctypes.create_string_buffer(LINGER.size), ctypes.c_uint32(LINGER.size)
    if libc.getsockopt(descriptor, *option, value, ctypes.byref(length)) or value.raw != ZENOHS:
        return False
    return not libc.setsockopt(descriptor, *option, LINGER.pack(0, 0), LINGER.size)


@functools.cache
def _libc() -> Any:
    return ctypes.CDLL(None)
