"""What a process that serves or calls devices has once: the event loop of its robots, and the signal that ends it.

The code of a robot runs on workers, so its device needs no loop of its own. The methods of a ready ``DeviceDriver`` are
coroutines of somebody else; such a driver gets a loop of its own, where it blocks no other device.

Importing this module needs no extra.
"""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from types import FrameType
from typing import Any, Self, TypeVar

T = TypeVar("T")

LOOP_JOIN_TIMEOUT_S = 5.0
"""Seconds that a failed or stopped bring-up, or a client, waits for its thread to end."""


class DeviceLoop:
    """An event loop on a thread; it ends when its last user has left."""

    def __init__(self) -> None:
        self._users = 0
        self._started: Future[asyncio.AbstractEventLoop] = Future()
        self._end: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._live, name="device-connect", daemon=True)
        self._thread.start()
        self.loop = self._started.result()

    def submit(self, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
        """Run a coroutine on the loop; cancelling the future cancels it."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop)

    def leave(self) -> None:
        """End one use; the last one ends loop and thread, without waiting for it."""
        with _lock:
            self._users -= 1
            if self._users:
                return
            _forget(self)
        assert self._end is not None
        self.loop.call_soon_threadsafe(self._end.set)

    def join(self, within: float) -> bool:
        """Wait for the thread to end where no user is left; False when it did not."""
        with _lock:
            if self._users:
                return True
        self._thread.join(within)
        return not self._thread.is_alive()

    def _live(self) -> None:
        with asyncio.Runner() as runner:
            runner.run(self._until_left())

    async def _until_left(self) -> None:
        self._end = asyncio.Event()
        self._started.set_result(asyncio.get_running_loop())
        await self._end.wait()

    def _enter(self) -> DeviceLoop:
        self._users += 1
        return self


_lock = threading.Lock()
_shared: list[DeviceLoop] = []


def enter_loop(*, alone: bool) -> DeviceLoop:
    """Return the loop of the process's robots, or one for a driver ``alone``.

    Every call needs one :meth:`DeviceLoop.leave`.
    """
    with _lock:
        if alone:
            return DeviceLoop()._enter()
        if not _shared:
            _shared.append(DeviceLoop())
        return _shared[0]._enter()


def _forget(loop: DeviceLoop) -> None:
    if loop in _shared:
        _shared.remove(loop)


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
