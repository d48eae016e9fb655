"""Event loops of devices: one for all robots, another for each foreign driver.

The code of a robot runs on workers, so its device needs no loop of its own. The methods of a ready ``DeviceDriver`` are
coroutines of somebody else; such a driver gets a loop of its own, where it blocks no other device.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")


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
