"""The event loop of a process's devices, and the signal that ends a program.

The code of a robot runs on workers, so its device needs no loop of its own. The methods of a ready ``DeviceDriver`` are
coroutines of somebody else; such a driver gets a loop of its own, where it blocks no other device.

Importing this module needs no extra.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any, Self

from strands_robots.threads import LoopThread

LOOP_JOIN_TIMEOUT_S = 5.0
"""Seconds that a failed or stopped bring-up, or a client, waits for its thread to end."""


class DeviceLoop(LoopThread):
    """The event loop of devices; it ends when its last user has left."""

    def __init__(self) -> None:
        super().__init__("device-connect")
        self._users = 0

    def enter(self) -> Self:
        """Begin one use."""
        self._users += 1
        return self

    def leave(self) -> None:
        """End one use; the last one ends loop and thread, without waiting for it."""
        with _lock:
            self._users -= 1
            if self._users:
                return
            if self in _shared:
                _shared.remove(self)
        self.end()

    def join(self, within: float) -> bool:
        """Wait for the thread to end where no user is left; False when it did not."""
        with _lock:
            if self._users:
                return True
        return super().join(within)


_lock = threading.Lock()
_shared: list[DeviceLoop] = []


def enter_loop(*, alone: bool) -> DeviceLoop:
    """Return the loop of the process's robots, or one for a driver ``alone``.

    Every call needs one :meth:`DeviceLoop.leave`.
    """
    with _lock:
        if alone:
            return DeviceLoop().enter()
        if not _shared:
            _shared.append(DeviceLoop())
        return _shared[0].enter()


class StopSignal:
    """Context in which the first SIGINT or SIGTERM ends :meth:`wait`.

    A second signal acts as before. Signal handlers exist in the main thread only; elsewhere entering raises
    ``ValueError``.

    ::

        with StopSignal() as stop:
            stop.wait()
            robot.halt("the operator ended the program")
            stop_device_connect(runtime)
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self._received = threading.Event()
        self._previous: dict[signal.Signals, Any] = {}
        self.number: int | None = None

    def __enter__(self) -> Self:
        for each in self.SIGNALS:
            self._previous[each] = signal.signal(each, self._on_signal)
        return self

    def __exit__(self, *_exception: object) -> None:
        self._restore()

    def wait(self, within: float | None = None) -> int | None:
        """Return the number of the signal, or None after ``within`` seconds."""
        # On some platforms a signal handler does not interrupt an untimed wait on a lock.
        left = within
        while not self._received.wait(0.2 if left is None else min(0.2, max(left, 0))):
            if left is not None:
                left -= 0.2
                if left <= 0:
                    return None
        return self.number

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        self._restore()
        self._received.set()

    def _restore(self) -> None:
        previous, self._previous = self._previous, {}
        for each, handler in previous.items():
            signal.signal(each, handler)
