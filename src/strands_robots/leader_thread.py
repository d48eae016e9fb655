"""A leader on a thread of its own, so that a read that hangs delays nothing."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

from strands_robots.errors import StrandsRobotsError


class LeaderSilentError(StrandsRobotsError):
    """A read of a leader that has not returned in time, or was interrupted."""


class LeaderThread:
    """Reads of one leader, one after another, on one thread.

    It starts with the first read.

    Args:
        name: of the leader, in messages and the thread's name.
        patience: seconds that a read may take.
    """

    def __init__(self, name: str, patience: float) -> None:
        self._name, self._patience = name, patience
        self._asked: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._given: queue.SimpleQueue[tuple[Any, BaseException | None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._over = ""

    def read(self, read: Callable[[], Any]) -> Any:
        """Return what ``read`` returns, or raise what it raises.

        Raises:
            LeaderSilentError: it has not returned in time, :meth:`interrupt` was called, or one of these was before.
        """
        if not self._over:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=f"leader-{self._name}", daemon=True)
                self._thread.start()
            self._asked.put(read)
            try:
                given = self._given.get(timeout=self._patience)
            except queue.Empty:
                given, self._over = None, f"{self._name} has not answered for {self._patience:g} s"
            if given is not None:
                value, failure = given
                if failure is not None:
                    raise failure
                return value
        # A late answer to this read would be taken for that of the next one.
        self.close()
        raise LeaderSilentError(f"{self._over}.")

    def interrupt(self) -> None:
        """End the wait for a read, from any thread; none is waited for any more."""
        self._over = self._over or f"{self._name} is not waited for any more"
        self._given.put(None)

    def close(self) -> None:
        """End the thread, once the read that it is in has returned."""
        self._over = self._over or f"{self._name} is not read any more"
        self._asked.put(None)

    def _run(self) -> None:
        while (read := self._asked.get()) is not None:
            try:
                self._given.put((read(), None))
            except BaseException as exc:  # noqa: BLE001 - a leader may raise anything; the reader gets it
                self._given.put((None, exc))
