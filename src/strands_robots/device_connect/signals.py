"""SIGINT and SIGTERM as something to wait for, so that a program stops its robot and leaves no ghost."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self


class StopSignal:
    """Within this context the first SIGINT or SIGTERM ends :meth:`wait`; a second one acts as it did before.

    Signal handlers exist in the main thread only; elsewhere entering raises ``ValueError``.

    ::

        with StopSignal() as asked:
            asked.wait()
            robot.halt("the operator ended the program")
            stop_device_connect(runtime)
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self._came = threading.Event()
        self._before: dict[signal.Signals, Any] = {}
        self.number: int | None = None

    def __enter__(self) -> Self:
        for each in self.SIGNALS:
            self._before[each] = signal.signal(each, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def wait(self, within: float | None = None) -> int | None:
        """The number of the signal that came, or None when ``within`` seconds passed without one."""
        # An untimed wait on a lock is one that a signal handler may not interrupt on every platform.
        left = within
        while not self._came.wait(0.2 if left is None else min(0.2, max(left, 0))):
            if left is not None:
                left -= 0.2
                if left <= 0:
                    return None
        return self.number

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        self._restore()
        self._came.set()

    def _restore(self) -> None:
        before, self._before = self._before, {}
        for each, handler in before.items():
            signal.signal(each, handler)
