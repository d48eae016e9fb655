"""Threads for robot verbs, with a share for each robot.

One pool serves the process and grows with the calls that run at the same moment; idle threads end by themselves. Its
threads are daemons: a robot call that never returns must not keep the process from ending. Stops never come here; they
have threads that stand ready (:mod:`strands_robots.safety.stop_executor`).
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, Generic, TypeVar

from strands_robots.contract import body_of
from strands_robots.errors import StrandsRobotsError
from strands_robots.stop_log import stop_logger
from strands_robots.utils import IdentityMap

logger = stop_logger(__name__)

T = TypeVar("T")
Job = Callable[[], None]

RUNNING_MAX = 4
"""Calls of one kind that run at once on one robot."""

WAITING_MAX = 32
"""Calls of one kind that wait for one of those; the next is refused as busy."""


class ShareFullError(StrandsRobotsError, RuntimeError):
    """As many calls of this kind as one robot may have are running or waiting."""


class WorkerPool:
    """Daemon threads, started on demand, that end after ``idle_s`` without work.

    Work comes to them by a :class:`Share`.
    """

    def __init__(self, idle_s: float = 2.0) -> None:
        self._idle_s = idle_s
        self._jobs: queue.SimpleQueue[tuple[Job, Share]] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._idle = 0

    @property
    def idle(self) -> int:
        """Threads without work."""
        return self._idle

    def _work(self, job: Job, share: Share, *, stays: bool = True) -> None:
        while True:
            due: Job | None = job
            while due is not None:
                try:
                    due()
                except BaseException:
                    logger.exception("A robot call failed outside its verb.")
                due = share._next()
            if not stays:
                return
            del job
            with self._lock:
                self._idle += 1
            try:
                job, share = self._jobs.get(timeout=self._idle_s)
            except queue.Empty:
                with self._lock:
                    # A job that was put between the timeout and here counted on this thread.
                    if self._idle:
                        self._idle -= 1
                        return
                job, share = self._jobs.get()


POOL = WorkerPool()
"""The process's threads for robot verbs."""


class Share:
    """One robot's part of the pool for one kind of call."""

    def __init__(self, running: int = RUNNING_MAX, waiting: int = WAITING_MAX, pool: WorkerPool = POOL) -> None:
        self._running_max, self._waiting_max = running, waiting
        self._pool = pool
        self._lock = threading.Lock()
        self._waiting: deque[Job] = deque()
        self._running = 0

    @property
    def waiting(self) -> int:
        """Calls that wait for their turn."""
        return len(self._waiting)

    def submit(self, job: Job) -> None:
        """Run ``job`` on a thread, in the order of arrival.

        Raises:
            ShareFullError: as many calls as may wait are waiting.
        """
        with self._lock:
            if self._running >= self._running_max:
                if len(self._waiting) >= self._waiting_max:
                    raise ShareFullError
                self._waiting.append(job)
                return
            self._running += 1
        pool = self._pool
        with pool._lock:
            if pool._idle:
                pool._idle -= 1
                pool._jobs.put((job, self))
                return
        # Taken out when it begins: a thread keeps its arguments, here a robot, until it ends.
        first = [job]
        thread = threading.Thread(target=lambda: pool._work(first.pop(), self), name="robot-call", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            # No thread can be started; the caller's carries it out.
            pool._work(job, self, stays=False)

    def call(self, call: Callable[[], T]) -> Future[T]:
        """Run ``call`` likewise; the future has what it returns or raises.

        Raises:
            ShareFullError: as many calls as may wait are waiting.
        """
        done: Future[T] = Future()
        self.submit(partial(_settle, done, call))
        return done

    def _next(self) -> Job | None:
        """Return the next call for the calling thread, or None and free its place."""
        with self._lock:
            if self._waiting:
                return self._waiting.popleft()
            self._running -= 1
            return None


UNBOUNDED = Share(sys.maxsize)
"""Work of the process itself, which belongs to no robot."""


class BoundedCall(Generic[T]):
    """Call of something foreign on a thread of the pool, awaited within a bound.

    One call runs at a time. While it hangs, no second thread is given to it and nobody waits for it again.
    """

    def __init__(self, call: Callable[[], T]) -> None:
        self._call = call
        self._starting = threading.Lock()
        self._latest: tuple[Future[T], float] | None = None

    def __call__(self, within: float) -> T:
        """Return what a call that began after this one returns, or raise its error.

        Raises:
            TimeoutError: no answer within ``within`` seconds, or one has been awaited for as long already.
        """
        asked = time.monotonic()
        while True:
            with self._starting:
                latest = self._latest
                if latest is None or latest[0].done():
                    began = time.monotonic()
                    latest = self._latest = (UNBOUNDED.call(self._call), began)
            future, began = latest
            try:
                future.exception(max(0.0, min(asked, began) + within - time.monotonic()))
            except TimeoutError:
                raise TimeoutError(f"no answer in {within:g} s") from None
            if began >= asked:
                return future.result()


class Shares:
    """Shares of one robot; none waits for another.

    ``motion`` starts motions, ``lasting`` waits for their end, ``read`` answers, ``urgent`` resumes and takes energy
    away. ``own_read`` has the reads that the robot declares: one that hangs costs no status.
    """

    def __init__(self, pool: WorkerPool = POOL) -> None:
        self.motion = Share(pool=pool)
        self.lasting = Share(pool=pool)
        self.read = Share(pool=pool)
        self.own_read = Share(pool=pool)
        self.urgent = Share(pool=pool)
        self.by_name: dict[str, Share] = {name: each for name, each in vars(self).items() if isinstance(each, Share)}


_SHARES: IdentityMap[Shares] = IdentityMap()


def shares_of(robot: object) -> Shares:
    """The shares of a robot, the same on every network that serves it."""
    return _SHARES.of(body_of(robot), Shares)


def loop_future() -> tuple[asyncio.Future[Any], Callable[[Any], None]]:
    """Return a future of the running loop, and what sets it from any thread."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[Any] = loop.create_future()

    def settle(value: object) -> None:
        if not future.done():
            future.set_result(value)

    def hand_over(value: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop closed while the robot was still busy
            loop.call_soon_threadsafe(settle, value)

    return future, hand_over


async def called(share: Share, call: Callable[[], T], within: float) -> T:
    """Return the result of ``call`` on a thread of ``share``, or raise its error.

    Raises:
        ShareFullError: the share is full.
        TimeoutError: no answer within ``within`` seconds; the call goes on and keeps its turn until it returns.
    """
    answered, hand_over = loop_future()
    share.call(call).add_done_callback(hand_over)
    # Not wait_for: in Python 3.11 it forgets a cancellation that comes together with the answer.
    async with asyncio.timeout(within):
        done: Future[T] = await answered
    return done.result()


def _settle(done: Future[T], call: Callable[[], T]) -> None:
    try:
        result = call()
    except BaseException as exc:  # noqa: BLE001 - handed to the caller
        done.set_exception(exc)
    else:
        done.set_result(result)
