"""Scheduler of the periodic jobs of a peer.

It has two threads, whatever the number of jobs: a timer that runs the quick ones itself (presence must not wait for a
motor bus), and a sampler for those that read hardware. A job that is late or still running skips its missed
deadlines; it never catches up in a burst.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

logger = logging.getLogger(__name__)

MIN_PERIOD_S = 0.001


@dataclass(slots=True)
class Job:
    """A callable due every ``period`` seconds; ``busy`` while queued or running."""

    name: str
    period: float
    run: Callable[[], None]
    quick: bool
    due: float
    busy: bool = False
    failures: int = 0


class Scheduler:
    """Runs jobs at their rates between :meth:`start` and :meth:`stop`.

    Args:
        name: of the threads.
        clock: monotonic seconds.
    """

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._name = name
        self._clock = clock
        self._wake = threading.Condition()
        self._jobs: dict[str, Job] = {}
        self._threads: list[threading.Thread] = []
        self._work: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._running = False

    def every(self, name: str, hz: float, run: Callable[[], None], *, quick: bool = False) -> None:
        """Run ``run`` ``hz`` times a second under ``name``; 0 or less is off."""
        with self._wake:
            if hz <= 0:
                self._jobs.pop(name, None)
            else:
                period = max(MIN_PERIOD_S, 1.0 / hz)
                self._jobs[name] = Job(name, period, run, quick, self._clock())
            self._wake.notify_all()

    def start(self) -> None:
        with self._wake:
            if self._running:
                return
            self._running = True
            self._work = queue.SimpleQueue()
            now = self._clock()
            for job in self._jobs.values():
                job.due, job.busy = now, False
        self._threads = [
            threading.Thread(target=self._time, name=f"{self._name}-timer", daemon=True),
            threading.Thread(target=self._sample, args=(self._work,), name=f"{self._name}-sampler", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self, timeout: float) -> list[str]:
        """End both threads within ``timeout`` s; return names of those still running."""
        with self._wake:
            self._running = False
            self._wake.notify_all()
        self._work.put(None)
        deadline = time.monotonic() + timeout
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, deadline - time.monotonic()))
        alive = [thread.name for thread in self._threads if thread.is_alive()]
        self._threads = []
        with self._wake:
            self._jobs.clear()
        return alive

    def run_due(self, now: float) -> None:
        """Run the jobs due at ``now`` in the calling thread; for tests with a clock."""
        for job in self._take_due(now):
            self._run(job)

    def _take_due(self, now: float) -> list[Job]:
        due: list[Job] = []
        for job in self._jobs.values():
            if job.due > now:
                continue
            missed = int((now - job.due) / job.period)
            job.due += (missed + 1) * job.period
            if not job.busy:
                job.busy = True
                due.append(job)
        return due

    def _time(self) -> None:
        while True:
            with self._wake:
                if not self._running:
                    return
                now = self._clock()
                due = self._take_due(now)
                if not due:
                    soonest = min((job.due for job in self._jobs.values()), default=now + 1.0)
                    self._wake.wait(max(0.0, soonest - now))
                    continue
            for job in due:
                if job.quick:
                    self._run(job)
                else:
                    self._work.put(job)

    def _sample(self, work: queue.SimpleQueue[Job | None]) -> None:
        while (job := work.get()) is not None:
            if self._running:
                self._run(job)

    def _run(self, job: Job) -> None:
        try:
            job.run()
        except Exception:
            job.failures += 1
            # A sensor that fails at 50 Hz must not fill the log.
            if job.failures & (job.failures - 1) == 0:
                logger.exception("%s: %s failed (%d times).", self._name, job.name, job.failures)
        else:
            job.failures = 0
        finally:
            job.busy = False
