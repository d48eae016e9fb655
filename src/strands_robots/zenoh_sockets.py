"""Sockets of Zenoh's links: closing one waits for no host that is gone.

Zenoh 1.10 sets ``SO_LINGER`` to 10 s on each TCP and TLS link (``TCP_LINGER_TIMEOUT`` of zenoh-link-tcp, fixed when it
is built). Where the other host is gone, Linux then keeps the thread that closes the socket for so long (socket(7)). It
is one of the few threads that all sessions of a process share: with half of a network dead, nothing is received from
the other half for 10 s a link.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
from pathlib import Path

LINGER = struct.Struct("ii")
"""``struct linger``: on or off, and seconds."""

ZENOHS = LINGER.pack(1, 10)
DESCRIPTORS = Path("/dev/fd")


def close_in_background() -> int:
    """Have the kernel close Zenoh's links in the background; return how many changed.

    What was sent is still delivered where the other host is there. Only sockets with Zenoh's own ten seconds are
    changed. Call it when a link has come up: Zenoh offers neither an option nor the descriptor of a link.
    """
    changed = 0
    try:
        descriptors = [int(each.name) for each in DESCRIPTORS.iterdir()]
    except OSError:  # no such folder on this system
        return 0
    for descriptor in descriptors:
        try:
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                changed += _in_background(descriptor)
        except OSError:  # closed meanwhile
            continue
    return changed


def _in_background(descriptor: int) -> bool:
    link = socket.socket(fileno=descriptor)
    try:
        if link.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size) != ZENOHS:
            return False
        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(0, 0))
        return True
    finally:
        link.detach()
