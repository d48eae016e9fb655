"""Threads that are ready, woken or in order; event loops; the end of a program."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import math
import queue
import signal
import threading
from collections import deque
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from types import FrameType
from typing import Any, Generic, Self, TypeVar

logger = logging.getLogger(__name__)

T = TypeVar("T")

LAST_TASKS_S = 1.0
"""Seconds in which cancelled tasks of a loop have to end."""


class ReadyThreads(Generic[T]):
    """A number of idle threads; each one that is taken is replaced at once.

    Work that blocks therefore never uses them up, and no work waits behind it.

    Args:
        label: begins the name of each thread.
        count: how many stand ready.
        work: done on one of them with each item.
        start: starts a thread; may raise ``RuntimeError``.
        used_up: called when the last idle thread was taken; :meth:`refill` is then due, on another thread.
    """

    def __init__(
        self,
        label: str,
        count: int,
        work: Callable[[T], None],
        start: Callable[[threading.Thread], None],
        used_up: Callable[[], None],
    ) -> None:
        self._label, self._count = label, count
        self._work, self._start, self._used_up = work, start, used_up
        self.items: queue.SimpleQueue[T | None] = queue.SimpleQueue()
        """An item put here is worked on, None is passed over."""
        self._counting = threading.Lock()
        self._idle = 0
        self._numbers = itertools.count()
        self.wanted = False
        """True from the first :meth:`prepare` that had a thread."""

    def prepare(self) -> None:
        """Make the threads ready.

        Raises:
            RuntimeError: no thread can be started, and none is idle.
        """
        self.wanted = True
        try:
            self.refill()
        except RuntimeError:
            self.wanted = self._idle > 0
            raise

    def refill(self) -> None:
        """Start threads until as many as wanted are idle.

        Raises:
            RuntimeError: no further thread can be started.
        """
        while True:
            # Counted first: a thread that has done its work meanwhile must not stay as one too many.
            with self._counting:
                if self._idle >= self._count or not self.wanted:
                    return
                self._idle += 1
            name = f"{self._label}-{next(self._numbers)}"
            try:
                self._start(threading.Thread(target=self._run, name=name, daemon=True))
            except BaseException:
                with self._counting:
                    self._idle -= 1
                raise

    def _run(self) -> None:
        while True:
            item = self.items.get()
            with self._counting:
                self._idle -= 1
                used_up = self._idle == 0
            if used_up:
                self._used_up()
            if item is not None:
                self._work(item)
            del item
            with self._counting:
                if self._idle >= self._count:
                    return
                self._idle += 1


class WokenThread:
    """Thread that sleeps until it is woken, started then, or something is due.

    Args:
        name: of the thread.
        step: done after each wake, and when something is due; it may not raise.
        due_in: returns the seconds until then; infinite where only a wake counts.
    """

    def __init__(self, name: str, step: Callable[[], None], due_in: Callable[[], float] = lambda: math.inf) -> None:
        self._name, self._step, self._due_in = name, step, due_in
        self._woken, self._starting = threading.Event(), threading.Lock()
        self._closed = False
        self._thread: threading.Thread | None = None

    def wake(self) -> None:
        """Have the step done soon; return at once.

        Raises:
            RuntimeError: no thread can be started; the next wake tries again.
        """
        if self._thread is None:
            with self._starting:
                if self._thread is None and not self._closed:
                    thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                    thread.start()
                    self._thread = thread
        if not self._woken.is_set():
            self._woken.set()

    def close(self, wait_s: float = 2.0) -> None:
        """End the thread after its step. Safe to call twice."""
        with self._starting:
            self._closed, thread = True, self._thread
        self._woken.set()
        if thread is not None and thread is not threading.current_thread():
            thread.join(wait_s)

    def _run(self) -> None:
        while not self._closed:
            left_s = self._due_in()
            if left_s > 0:
                self._woken.wait(None if left_s == math.inf else left_s)
            self._woken.clear()
            if not self._closed:
                self._step()


class BoundedExecutor:
    """One thread, and at most ``depth`` jobs that wait for it.

    The thread starts with the first job, or by :meth:`prepare`. A full executor forgets its oldest job for a new one.
    """

    def __init__(self, name: str, depth: int) -> None:
        self._name = name
        self._jobs: deque[Callable[[], None]] = deque(maxlen=depth)
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._open = True
        self.dropped = 0

    def submit(self, work: Callable[[], None]) -> None:
        """Queue a job; a closed executor drops it."""
        with self._changed:
            if not self._open:
                return
            self.dropped += len(self._jobs) == self._jobs.maxlen
            self._jobs.append(work)
            self._changed.notify()
            if self._thread is not None:
                return
            thread = self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        # Without the lock, so that the thread takes its first job before a close can drop it.
        self._begin(thread)

    def prepare(self) -> None:
        """Start the thread now, so that the first job waits for no system call.

        Where the system has none, the first job tries again.
        """
        with self._changed:
            if not self._open or self._thread is not None:
                return
            thread = self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        with contextlib.suppress(RuntimeError):
            self._begin(thread)

    def close(self) -> None:
        """Take no more jobs, drop waiting ones, and let the thread end."""
        with self._changed:
            self._open = False
            self.dropped += len(self._jobs)
            self._jobs.clear()
            self._changed.notify()

    def stop(self, timeout: float) -> list[str]:
        """Close and wait; return the name of a thread that still runs."""
        self.close()
        return self.join(timeout)

    def join(self, timeout: float) -> list[str]:
        """Wait for the thread of a closed executor; its name while it still runs."""
        thread = self._thread
        if thread is None or thread.ident is None:
            return []
        if thread is not threading.current_thread():
            thread.join(timeout)
        return [thread.name] if thread.is_alive() else []

    def _begin(self, thread: threading.Thread) -> None:
        try:
            thread.start()
        except RuntimeError:
            self._thread = None
            raise

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs:
                    if not self._open:
                        return
                    self._changed.wait()
                work = self._jobs.popleft()
            try:
                work()
            except Exception:
                logger.exception("%s: a job failed.", self._name)


class LoopThread:
    """An event loop on a thread of its own."""

    def __init__(self, name: str) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._live, name=name, daemon=True)
        self._thread.start()

    def submit(self, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
        """Run a coroutine on the loop; cancelling the future cancels it."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop)

    def end(self) -> None:
        """Have what runs there cancelled, and loop and thread end; return at once."""
        with contextlib.suppress(RuntimeError):  # it has ended
            self.loop.call_soon_threadsafe(self.loop.stop)

    def join(self, within: float) -> bool:
        """Wait for the thread to end; False when it did not."""
        self._thread.join(within)
        return not self._thread.is_alive()

    def close(self, wait_s: float = 5.0) -> None:
        """End it, and wait for the thread."""
        self.end()
        self.join(wait_s)

    def _live(self) -> None:
        try:
            self.loop.run_forever()
            self.loop.run_until_complete(self._cancel_tasks())
        finally:
            self.loop.close()

    async def _cancel_tasks(self) -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=LAST_TASKS_S)
        await self.loop.shutdown_asyncgens()


LOOP_JOIN_TIMEOUT_S = 5.0
"""Seconds that a failed or stopped bring-up, or a client, waits for its thread to end."""


class StopSignal:
    """Context in which the first SIGINT or SIGTERM ends :meth:`wait`.

    A second signal acts as before. Signal handlers exist in the main thread only; elsewhere entering raises
    ``ValueError``.

    ::

        with StopSignal() as stop:
            stop.wait()
            robot.halt("the operator ended the program")
            stop_device_connect(runtime)
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self._received = threading.Event()
        self._previous: dict[signal.Signals, Any] = {}
        self.number: int | None = None

    def __enter__(self) -> Self:
        for each in self.SIGNALS:
            self._previous[each] = signal.signal(each, self._on_signal)
        return self

    def __exit__(self, *_exception: object) -> None:
        self._restore()

    def wait(self, within: float | None = None) -> int | None:
        """Return the number of the signal, or None after ``within`` seconds."""
        # On some platforms a signal handler does not interrupt an untimed wait on a lock.
        left = within
        while not self._received.wait(0.2 if left is None else min(0.2, max(left, 0))):
            if left is not None:
                left -= 0.2
                if left <= 0:
                    return None
        return self.number

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        self._restore()
        self._received.set()

    def _restore(self) -> None:
        previous, self._previous = self._previous, {}
        for each, handler in previous.items():
            signal.signal(each, handler)
