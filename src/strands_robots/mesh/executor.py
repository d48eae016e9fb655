"""Few threads and a bounded queue for work off the transport's thread."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)

Work = Callable[[], None]


class BoundedExecutor:
    """At most ``workers`` threads, started with the first job, and ``depth`` jobs.

    Args:
        drop_oldest: a full executor forgets its oldest job instead of refusing the new one.
    """

    def __init__(self, name: str, workers: int, depth: int, *, drop_oldest: bool = False) -> None:
        self._name = name
        self._workers = workers
        self._queue: queue.Queue[Work | None] = queue.Queue(depth)
        self._drop_oldest = drop_oldest
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._open = True
        self._accepted = self._done = 0
        self.dropped = 0

    def submit(self, work: Work) -> bool:
        """Queue a job; False when the executor is full or closed."""
        if not self._open:
            return False
        while True:
            try:
                self._queue.put_nowait(work)
                break
            except queue.Full:
                if not self._drop_oldest:
                    return False
                self._forget_oldest()
        with self._lock:
            self._accepted += 1
            # Counted from here and not from a worker's start: of jobs that come together each gets its own.
            short = len(self._threads) < self._workers and self._accepted - self._done > len(self._threads)
            # Once closed, no thread takes the job: one made now would wait for ever.
            if self._open and short:
                self._add()
            return self._open

    def close(self) -> None:
        """Take no more jobs, drop waiting ones, and let the threads end."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            threads = list(self._threads)
        while not self._queue.empty():
            self._forget_oldest()
        for _ in threads:
            self._queue.put(None)

    def stop(self, timeout: float) -> list[str]:
        """Close and wait; return the names of threads still running."""
        self.close()
        return self.join(timeout)

    def join(self, timeout: float) -> list[str]:
        """Wait for the threads of a closed executor; names of those still running."""
        with self._lock:
            threads = list(self._threads)
        deadline = time.monotonic() + timeout
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
        return [thread.name for thread in threads if thread.is_alive()]

    def _add(self) -> None:
        thread = threading.Thread(target=self._run, name=f"{self._name}-{len(self._threads)}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _forget_oldest(self) -> None:
        try:
            self._queue.get_nowait()
        except queue.Empty:
            return
        self.dropped += 1
        with self._lock:
            self._done += 1

    def _run(self) -> None:
        while (work := self._queue.get()) is not None:
            try:
                work()
            except Exception:
                logger.exception("%s: a job failed.", self._name)
            finally:
                with self._lock:
                    self._done += 1
