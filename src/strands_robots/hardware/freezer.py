"""Freezing a body within a deadline, though its bus may hang."""

from __future__ import annotations

import logging
import threading

from strands_robots.hardware.body import DeviceBody

logger = logging.getLogger(__name__)


class NoAnswerError(TimeoutError):
    """The bus did not answer in time; a device's own TimeoutError is another thing."""


class _Attempt:
    """One passage of the bus lock. ``done`` is set while the lock is still held."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.failure: Exception | None = None


class Freezer:
    """Waits for the write in flight and freezes, on a thread of its own, so that whoever halts is never held up.

    An attempt that finds the bus hung stays in line: the body is frozen as soon as the bus answers. Meanwhile
    further halts wait for that attempt instead of adding threads. That is enough, because every permit is void
    before an attempt is asked for: what was written before has been written before its passage of the lock.
    """

    def __init__(self, body: DeviceBody) -> None:
        self._body = body
        self._guard = threading.Lock()
        self._attempt: _Attempt | None = None

    def freeze(self, within_s: float) -> None:
        """Return when the body is frozen and no write is in flight.

        Raises:
            NoAnswerError: no answer of the bus in ``within_s`` seconds.
            Exception: what the device raised; nothing is in flight, but it was not frozen.
        """
        with self._guard:
            attempt = self._attempt
            if attempt is None or attempt.done.is_set():
                attempt = self._attempt = _Attempt()
                threading.Thread(
                    target=self._pass, args=(attempt,), name=f"freeze-{self._body.name}", daemon=True
                ).start()
        if not attempt.done.wait(within_s):
            raise NoAnswerError(f"no answer in {within_s:g} s")
        if attempt.failure is not None:
            raise attempt.failure

    def _pass(self, attempt: _Attempt) -> None:
        with self._body.lock:
            try:
                if self._body.is_connected or self._body.lost:
                    self._body.stop()
            except Exception as exc:  # noqa: BLE001 - a device may raise anything; the halt reports it
                attempt.failure = exc
                logger.critical("%s could not be frozen: %s: %s", self._body.name, type(exc).__name__, exc)
            finally:
                attempt.done.set()
