"""Locks by which processes begin to serve a robot one after another.

They are of one state directory. A process holds the lock of a robot from its last look at who serves it until its own
row is on disk, so that of two which begin at once the later one sees the earlier. Locks are bytes of one empty file;
the system frees those of a process that dies.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import threading
from pathlib import Path

from strands_robots.safety.network_key import NetworkKey
from strands_robots.state_files import make_private


class StartLocks:
    """Start locks that this process holds; callable from any thread."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / "starting.lock"
        self._lock = threading.Lock()
        self._held: dict[tuple[NetworkKey, str], int] = {}
        self._descriptor: int | None = None

    def take(self, network: NetworkKey, name: str) -> bool:
        """Take the lock of a robot, at once; False while another process holds it.

        Robots of one name and tenant share a lock, whatever their network.

        Raises:
            OSError: the file cannot be locked.
        """
        place = int.from_bytes(hashlib.sha256(f"{network.tenant} {name}".encode()).digest()[:7], "big")
        with self._lock:
            if self._descriptor is None:
                make_private(self._path.parent)
                flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
                self._descriptor = os.open(self._path, flags, 0o600)
            try:
                fcntl.lockf(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
            except BlockingIOError:
                self._close_unused()
                return False
            self._held[network, name] = place
            return True

    def free(self, network: NetworkKey, name: str) -> None:
        """Give the lock of a robot back, where this process holds it."""
        with self._lock:
            place = self._held.pop((network, name), None)
            if self._descriptor is not None and place is not None and place not in self._held.values():
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN, 1, place)
                self._close_unused()

    def _close_unused(self) -> None:
        # Closing any descriptor of the file frees every lock of this process.
        if self._descriptor is not None and not self._held:
            os.close(self._descriptor)
            self._descriptor = None
