"""Threads for robot verbs, so that none of them runs on the event loop and none stands behind a blocked one.

One pool serves the whole process and grows with the calls that are running at the same moment; idle threads end
by themselves. What bounds it is a :class:`Lane` for each robot and kind of call: a wedged robot fills its own
lane and nobody else's, and its stops have a lane that motion and reads never enter. The threads are daemons,
because a robot call that never returns must not keep the process from ending.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")
Job = Callable[[], None]


class LaneFullError(RuntimeError):
    """As many calls of this kind as may run on one robot are running already."""


class WorkerPool:
    """Daemon threads that appear when no idle one is left and end after ``idle_s`` without work."""

    def __init__(self, idle_s: float = 2.0) -> None:
        self._idle_s = idle_s
        self._jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._free = 0

    def submit(self, job: Job) -> None:
        """Run ``job``, which may not raise, at once on some thread."""
        with self._lock:
            if self._free:
                self._free -= 1
                self._jobs.put(job)
                return
        thread = threading.Thread(target=self._work, args=(job,), name="robot-call", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            # The interpreter is ending and starts no more threads.
            job()

    def _work(self, job: Job) -> None:
        while True:
            job()
            del job
            with self._lock:
                self._free += 1
            try:
                job = self._jobs.get(timeout=self._idle_s)
            except queue.Empty:
                with self._lock:
                    # A job that was put between the timeout and here counted on this thread.
                    if self._free:
                        self._free -= 1
                        return
                job = self._jobs.get()


POOL = WorkerPool()
"""The process's threads for robot verbs."""


class Lane:
    """At most ``limit`` calls of one kind at a time on one robot; a call beyond it is refused, never queued."""

    def __init__(self, name: str, limit: int, pool: WorkerPool = POOL) -> None:
        self.name = name
        self._slots = threading.Semaphore(limit)
        self._pool = pool

    def start(self, call: Callable[[], T]) -> Future[T]:
        """Run ``call`` on a thread of its own at once. Raises :class:`LaneFullError` where the lane is full."""
        if not self._slots.acquire(blocking=False):
            raise LaneFullError(self.name)
        done: Future[T] = Future()

        def job() -> None:
            try:
                result = call()
            except BaseException as exc:  # noqa: BLE001 - handed to whoever waits
                self._slots.release()
                done.set_exception(exc)
            else:
                self._slots.release()
                done.set_result(result)

        self._pool.submit(job)
        return done

    async def run(self, call: Callable[[], T], within: float) -> T:
        """The result of ``call``, waited for without blocking the loop.

        Raises:
            LaneFullError: the lane is full.
            TimeoutError: no answer within ``within`` seconds; the call goes on and keeps its slot until it returns.
        """
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[T] = loop.create_future()

        def hand_over(done: Future[T]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop closed while the robot was still busy
                loop.call_soon_threadsafe(settle, done)

        def settle(done: Future[T]) -> None:
            if answer.done():
                done.exception()
                return
            exc = done.exception()
            if exc is None:
                answer.set_result(done.result())
            else:
                answer.set_exception(exc)

        self.start(call).add_done_callback(hand_over)
        # Not wait_for: in Python 3.11 it forgets a cancellation that comes together with the answer.
        async with asyncio.timeout(within):
            return await answer
