"""Log of the safety plane, written on a thread of its own.

A log line ends in a handler of somebody else's: a terminal that is paused, or a pipe that nobody reads, blocks it for
good. No stop may wait for that, so the modules on its way hand their records over and go on.
"""

from __future__ import annotations

import atexit
import logging
import os
import threading
import time
from collections import deque

RECORDS_MAX = 1000
"""Records that wait for their handlers; beyond it the newest are dropped and counted."""

DROPPED = "%d log records were dropped while a handler was blocked."

ENDING_S = 1.0
"""Seconds that the end of the process waits for the last records."""


class LogWriter(logging.Filter):
    """Filter that takes the records of a logger and has them handled on its thread."""

    def __init__(self) -> None:
        super().__init__()
        self._records: deque[tuple[logging.Logger, logging.LogRecord]] = deque()
        self._waiting = threading.Event()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None
        self._busy = False
        self.dropped = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Take the record; True, to have it handled here, where no thread can be had."""
        if self._thread is None and not self._started():
            return True
        if len(self._records) >= RECORDS_MAX:
            self.dropped += 1
            return False
        self._records.append((logging.getLogger(record.name), record))
        self._waiting.set()
        return False

    def flush(self, within: float = ENDING_S) -> bool:
        """Wait until every record was handled; False where that takes longer."""
        deadline = time.monotonic() + within
        # In this order: the thread is busy before it takes the mark away.
        while self._waiting.is_set() or self._busy:
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.002)
        return True

    def _started(self) -> bool:
        with self._starting:
            if self._thread is None:
                thread = threading.Thread(target=self._write, name="stop-log", daemon=True)
                try:
                    thread.start()
                except RuntimeError:
                    return False
                self._thread = thread
        return True

    def _write(self) -> None:
        while True:
            self._waiting.wait()
            self._busy = True
            self._waiting.clear()
            while self._records:
                logger, record = self._records.popleft()
                dropped, self.dropped = self.dropped, 0
                try:
                    if dropped:
                        logger.callHandlers(
                            logger.makeRecord(logger.name, logging.WARNING, "", 0, DROPPED, (dropped,), None)
                        )
                    logger.callHandlers(record)
                except Exception:  # noqa: BLE001 - a handler of somebody else's must not end the log of the others
                    if logging.lastResort is not None:
                        logging.lastResort.handleError(record)
            self._busy = False


class _OfProcess:
    writer = LogWriter()

    @classmethod
    def renew(cls) -> None:
        """Write anew in a forked child, which has none of its parent's threads."""
        taken, cls.writer = cls.writer, LogWriter()
        for logger in list(logging.Logger.manager.loggerDict.values()):
            if isinstance(logger, logging.Logger) and taken in logger.filters:
                logger.removeFilter(taken)
                logger.addFilter(cls.writer)


os.register_at_fork(after_in_child=_OfProcess.renew)


def stop_logger(name: str) -> logging.Logger:
    """Return the logger of a module on the way of a stop; its calls never block."""
    logger = logging.getLogger(name)
    logger.addFilter(_OfProcess.writer)
    return logger


@atexit.register
def flush_stop_log(within: float = ENDING_S) -> bool:
    """Wait until every record was handled; False where a handler blocks for longer."""
    return _OfProcess.writer.flush(within)
