"""The zero behind the commands, on a thread that a stop does not wait for."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

from strands_robots.ros.link import RosError


class Behind:
    """Sends one zero at a time in the order of the commands, however long the write before it takes.

    Args:
        zero: sends it; may block for as long as the connection is clogged.
    """

    def __init__(self, zero: Callable[[], None]) -> None:
        self._zero = zero
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._began = 0.0
        self._problem = ""

    def offer(self) -> float:
        """Have a zero sent, unless one still waits for its turn: then for how many seconds it has.

        Where no thread is to be had none is sent, which :meth:`confirm` makes good.
        """
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                return time.monotonic() - self._began
            self._began = time.monotonic()
            self._problem = ""
            self._thread = None
            thread = threading.Thread(target=self._run, name="hold-behind", daemon=True)
            with contextlib.suppress(RuntimeError):  # the other way of the zero is still open, and needs no thread
                thread.start()
                self._thread = thread
            return 0.0

    def confirm(self, within_s: float) -> None:
        """Wait until the zero is sent, or send the one without a thread. Raises :class:`RosError` where it was not."""
        thread = self._thread
        if thread is None:
            self._run()
        else:
            thread.join(within_s)
            if thread.is_alive():
                raise RosError(f"the connection has not taken a zero within {within_s:g} s")
        if self._problem:
            raise RosError(self._problem)

    def _run(self) -> None:
        try:
            self._zero()
        except Exception as exc:  # noqa: BLE001 - whatever the link raises is told to who asks
            self._problem = str(exc) or type(exc).__name__
