"""Locks by which processes begin to serve a robot one after another.

They are of one state directory. A process holds the lock of a robot from its last look at who serves it until its own
row is on disk, so that of two which begin at once the later one sees the earlier. Locks are bytes of one file; the
system frees those of a process that dies.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import threading
from pathlib import Path

from strands_robots.safety.network_key import NetworkKey
from strands_robots.state_files import make_private

PLACES = 2**20
"""Locks of the file. Robots that share one by chance begin one after another, no more."""


class StartLocks:
    """Start locks that this process holds; callable from any thread.

    The byte of a lock counts how often it was given back, after the row was written: a process sees by it that no row
    has come since it looked.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / "starting.lock"
        self._lock = threading.Lock()
        self._held: dict[tuple[NetworkKey, str], int] = {}
        self._descriptor: int | None = None

    def count(self, network: NetworkKey, name: str) -> int:
        """Return how often the lock of a robot was given back, modulo 256.

        Raises:
            OSError: the file cannot be read.
        """
        with self._lock:
            try:
                return self._count(self._opened(), _place(network, name))
            finally:
                self._close_unused()

    def take(self, network: NetworkKey, name: str) -> int | None:
        """Take the lock of a robot, at once; None while another process holds it.

        Robots of one name and tenant share a lock, whatever their network.

        Returns:
            The present :meth:`count`.

        Raises:
            OSError: the file cannot be locked.
        """
        place = _place(network, name)
        with self._lock:
            try:
                descriptor = self._opened()
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
                self._held[network, name] = place
                return self._count(descriptor, place)
            except BlockingIOError:
                return None
            finally:
                self._close_unused()

    def free(self, network: NetworkKey, name: str) -> None:
        """Give the lock of a robot back, where this process holds it."""
        with self._lock:
            place = self._held.pop((network, name), None)
            if self._descriptor is None or place is None:
                return
            # On a full disk the row was not written either.
            with contextlib.suppress(OSError):
                os.pwrite(self._descriptor, bytes([(self._count(self._descriptor, place) + 1) % 256]), place)
            if place not in self._held.values():
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN, 1, place)
            self._close_unused()

    @staticmethod
    def _count(descriptor: int, place: int) -> int:
        return int.from_bytes(os.pread(descriptor, 1, place), "big")

    def _opened(self) -> int:
        if self._descriptor is None:
            make_private(self._path.parent)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            self._descriptor = os.open(self._path, flags, 0o600)
        return self._descriptor

    def _close_unused(self) -> None:
        # Closing any descriptor of the file frees every lock of this process.
        if self._descriptor is not None and not self._held:
            os.close(self._descriptor)
            self._descriptor = None


def _place(network: NetworkKey, name: str) -> int:
    digest = hashlib.sha256(f"{network.tenant} {name}".encode()).digest()
    return int.from_bytes(digest[:4], "big") % PLACES
