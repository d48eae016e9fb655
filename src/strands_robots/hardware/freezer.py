"""Freezing a body within a deadline, though its bus may hang."""

from __future__ import annotations

import logging
import queue
import threading
import weakref
from collections.abc import Callable

from strands_robots.hardware.body import DeviceBody

logger = logging.getLogger(__name__)


class NoAnswerError(TimeoutError):
    """The bus did not answer in time; a device's own TimeoutError is another thing."""


class _Attempt:
    """One passage of the bus lock. ``done`` is set while the lock is still held."""

    def __init__(self, body: DeviceBody) -> None:
        self.body = body
        self.done = threading.Event()
        self.failure: Exception | None = None


_Attempts = queue.SimpleQueue[_Attempt | None]


class Freezer:
    """Waits for the write in flight and freezes, on a thread of its own, so that whoever halts is never held up.

    The thread stands ready while the robot may move: a busy machine gives a new one its first turn late, up to
    150 ms late where three programs compute on two cores. It ends with :meth:`close`, or with this object.

    An attempt that finds the bus hung stays in line: the body is frozen as soon as the bus answers. Meanwhile
    further halts wait for that attempt instead of adding others. That is enough, because every permit is void
    before an attempt is asked for: what was written before has been written before its passage of the lock.
    """

    def __init__(self, body: DeviceBody) -> None:
        self._body = body
        self._guard = threading.Lock()
        self._attempt: _Attempt | None = None
        self._attempts: _Attempts | None = None
        self._end: Callable[[], object] | None = None

    def ready(self) -> None:
        """Have the thread stand by; cheap when it does."""
        if self._attempts is None:
            with self._guard:
                self._stand_by()

    def freeze(self, within_s: float) -> None:
        """Return when the body is frozen and no write is in flight.

        Raises:
            NoAnswerError: no answer of the bus in ``within_s`` seconds.
            Exception: what the device raised; nothing is in flight, but it was not frozen.
        """
        with self._guard:
            attempt = self._attempt
            if attempt is None or attempt.done.is_set():
                attempt = self._attempt = _Attempt(self._body)
                self._stand_by().put(attempt)
        if not attempt.done.wait(within_s):
            raise NoAnswerError(f"no answer in {within_s:g} s")
        if attempt.failure is not None:
            raise attempt.failure

    def close(self) -> None:
        """Let the thread end, after an attempt that is under way; the next use starts another."""
        with self._guard:
            self._attempts = None
            if self._end is not None:
                self._end()

    def _stand_by(self) -> _Attempts:
        if self._attempts is None:
            attempts = self._attempts = queue.SimpleQueue()
            self._end = ended = weakref.finalize(self, attempts.put, None)
            ended.atexit = False
            name = f"freeze-{self._body.name}"
            threading.Thread(target=_work, args=(attempts,), name=name, daemon=True).start()
        return self._attempts


def _work(attempts: _Attempts) -> None:
    while (attempt := attempts.get()) is not None:
        _pass(attempt)
        # Waiting for the next one must not keep the robot of the last alive.
        del attempt


def _pass(attempt: _Attempt) -> None:
    body = attempt.body
    with body.stopping():
        try:
            if body.is_connected or body.lost or body.driven:
                body.stop()
        except BaseException as exc:  # noqa: BLE001 - a device may raise anything; the halt reports it
            attempt.failure = exc if isinstance(exc, Exception) else RuntimeError(repr(exc))
            logger.critical("%s could not be frozen: %s: %s", body.name, type(exc).__name__, exc)
        finally:
            attempt.done.set()
