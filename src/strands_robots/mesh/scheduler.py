"""Periodic jobs of a process's peers, and bounds on what they record and log.

One timer thread runs the quick jobs of all peers: a heartbeat waits for no motor bus. What may block, such as a read
of hardware, runs on workers. One is enough while nothing blocks; where work waits another one relieves it, and ends
when the work is done. A job that is late or still running skips its missed deadlines; it never catches up in a burst.
"""

from __future__ import annotations

import heapq
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from strands_robots.audit import queue_safety_event

AuditSink = Callable[[str, str, dict[str, Any]], None]
"""Event type, peer id, payload; returns at once and never raises."""

BURST = 5
WINDOW_S = 1.0
KINDS_MAX = 1024


@dataclass(slots=True)
class _Window:
    since: float
    written: int = 0
    left_out: int = 0


class AuditThrottle:
    """Writes the safety events of one peer to ``sink``; thread-safe.

    A hostile peer can make the mesh refuse a thousand messages a second. Each kind of refusal from each peer is
    written :data:`BURST` times in :data:`WINDOW_S`, and the next record states how many were left out.
    """

    def __init__(
        self, peer_id: str, sink: AuditSink = queue_safety_event, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._peer = peer_id
        self._sink = sink
        self._clock = clock
        self._windows: dict[tuple[str, str], _Window] = {}
        self._lock = threading.Lock()

    def __call__(self, event: str, about: str = "", **payload: Any) -> None:
        """Record ``event``, which concerns the peer ``about``; in a flood, some of them."""
        about = about[:128]
        left_out = self._admit((event, about))
        if left_out is None:
            return
        if left_out:
            payload["left_out_before"] = left_out
        if about:
            payload.setdefault("about", about)
        self._sink(event, self._peer, payload)

    def always(self, event: str, **payload: Any) -> None:
        """Record an event that is never left out, such as a stop."""
        self._sink(event, self._peer, payload)

    def close(self) -> None:
        """Record the counts of events left out since the last of their kind."""
        with self._lock:
            counts = {kind: window.left_out for kind, window in self._windows.items() if window.left_out}
            self._windows.clear()
        for (event, about), left_out in counts.items():
            self._sink(event, self._peer, {"about": about, "left_out": left_out})

    def _admit(self, kind: tuple[str, str]) -> int | None:
        now = self._clock()
        with self._lock:
            window = self._windows.get(kind)
            if window is None:
                if len(self._windows) >= KINDS_MAX:
                    # A peer that invents names shares one window with all the others that do.
                    kind = (kind[0], "")
                window = self._windows.setdefault(kind, _Window(now))
            left_out = 0
            if now - window.since >= WINDOW_S:
                left_out, window.left_out, window.written, window.since = window.left_out, 0, 0, now
            if window.written >= BURST:
                window.left_out += 1
                return None
            window.written += 1
            return left_out


class TroubleLog:
    """Logs the trouble of each subject once, until it changes or ends."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._kinds: dict[str, str] = {}

    def note(self, subject: str, kind: str, message: str, *args: object, level: int = logging.WARNING) -> None:
        """Log ``message`` where ``kind`` is new for ``subject``; empty is no trouble."""
        if kind and kind != self._kinds.get(subject):
            self._logger.log(level, message, *args)
        self._kinds[subject] = kind


logger = logging.getLogger(__name__)

MIN_PERIOD_S = 0.001
TICK_S = 0.01
"""Quick jobs at least ten times as slow are due on whole ones, so that those of many peers share a wake-up."""

SPREAD = (math.sqrt(5) - 1) / 2
"""Each further peer reads by this share of a period later: Zenoh drops readings that come close together on a link."""

END_S = 0.5
"""Seconds that the end of the process waits for jobs that run; one that reads a wedged bus is left to itself."""

RELIEF_S = 0.02
"""Work that waits this long for a worker gets another one."""


@dataclass(slots=True, eq=False)
class JobQueue:
    """Jobs of one peer that run one after another; ``busy`` while a worker has them."""

    waiting: deque[Job] = field(default_factory=deque)
    busy: bool = False


@dataclass(slots=True, eq=False)
class Job:
    """A callable due every ``period`` seconds; ``busy`` while queued or running.

    Attributes:
        queue: None for a quick job, which runs on the timer.
        phase: share of a period by which its second turn is moved, from -0.5 to 0.5; 0 from then on.
        over: it begins no more.
        runner: the thread that runs it now.
    """

    name: str
    period: float
    run: Callable[[], None]
    queue: JobQueue | None = None
    phase: float = 0.0
    due: float = 0.0
    busy: bool = False
    over: bool = True
    runner: threading.Thread | None = None
    failures: int = 0

    def skip_to(self, now: float) -> None:
        """Be due at the first deadline after ``now``."""
        self.due += (int((now - self.due) / self.period) + 1) * self.period
        if self.queue is not None:
            self.due, self.phase = self.due + self.phase * self.period, 0.0
        elif self.period >= 10 * TICK_S:
            self.due = math.ceil(self.due / TICK_S - 1e-6) * TICK_S


class Timer:
    """Runs jobs at their times: one thread, and workers for those that may block.

    The threads begin with the first job and end with the last.

    Args:
        name: of the threads.
    """

    def __init__(self, name: str = "mesh") -> None:
        self._name = name
        self._lock = threading.Lock()
        self._changed, self._work, self._finished = (threading.Condition(self._lock) for _ in range(3))
        self._heap: list[tuple[float, int, Job]] = []
        self._numbers = count()
        self._jobs = 0
        self._ready: deque[tuple[float, JobQueue]] = deque()
        self._idle = self._workers = 0
        self._thread: threading.Thread | None = None
        self._refusals = TroubleLog(logger)

    def add(self, jobs: Iterable[Job]) -> None:
        """Run these jobs, each for the first time now."""
        with self._lock:
            for job in jobs:
                job.due, job.over = time.monotonic(), False
                self._push(job)
                self._jobs += 1
            if self._thread is None and self._jobs:
                self._thread = self._begun(self._time, "timer")
            self._changed.notify()

    def remove(self, jobs: Iterable[Job]) -> None:
        """Begin these jobs no more, without waiting for them."""
        with self._lock:
            for job in jobs:
                self._jobs -= not job.over
                job.over = True
            if not self._jobs:
                self._heap.clear()
                self._changed.notify()
                self._work.notify_all()

    def pace(self, job: Job, period: float, phase: float, *, soon: bool) -> None:
        """Run a job every ``period`` seconds from now on.

        Args:
            phase: share of a period by which its second turn is moved.
            soon: run it now; otherwise a slower job goes on with the turn that is due.
        """
        with self._lock:
            sooner, job.period = period < job.period, period
            if job.over or not (soon or sooner):
                return
            job.due, job.phase = time.monotonic() + (0.0 if soon else period), phase
            self._push(job)
            self._changed.notify()

    def wait(self, jobs: Iterable[Job], timeout: float) -> list[str]:
        """Wait until none runs on another thread; names of those that do."""
        own, jobs = threading.current_thread(), list(jobs)

        def running() -> list[str]:
            return [job.name for job in jobs if job.runner is not None and job.runner is not own]

        with self._finished:
            self._finished.wait_for(lambda: not running(), timeout)
            return running()

    def end(self) -> None:
        """Begin no job any more, and wait a moment for those that run."""
        with self._lock:
            jobs = [job for _, _, job in self._heap if not job.over]
        self.remove(jobs)
        self.wait(jobs, END_S)

    def _begun(self, target: Callable[[], None], kind: str) -> threading.Thread:
        thread = threading.Thread(target=target, name=f"{self._name}-{kind}", daemon=True)
        thread.start()
        return thread

    def _push(self, job: Job) -> None:
        heapq.heappush(self._heap, (job.due, next(self._numbers), job))

    def _time(self) -> None:
        while True:
            with self._lock:
                if not self._jobs:
                    self._thread = None
                    return
                now = time.monotonic()
                quick = self._take_due(now)
                if not quick:
                    soonest = min(self._heap[0][0] if self._heap else math.inf, self._relieve(now))
                    self._changed.wait(None if soonest == math.inf else max(0.0, soonest - now))
                    continue
            for job in quick:
                self._run(job)

    def _take_due(self, now: float) -> list[Job]:
        """Return the quick jobs due; hand the others to workers."""
        quick: list[Job] = []
        while self._heap and self._heap[0][0] <= now:
            due, _, job = heapq.heappop(self._heap)
            # An entry of another time is that of a job whose pace was changed.
            if job.over or due != job.due:
                continue
            job.skip_to(now)
            self._push(job)
            if job.busy:
                continue
            job.busy = True
            if job.queue is None:
                quick.append(job)
                continue
            job.queue.waiting.append(job)
            if not job.queue.busy:
                job.queue.busy = True
                self._hand_over(job.queue, now)
        return quick

    def _hand_over(self, queue: JobQueue, now: float) -> None:
        self._ready.append((now, queue))
        self._work.notify()

    def _relieve(self, now: float) -> float:
        """Add a worker where work waits; return when to look again."""
        if not self._ready:
            return math.inf
        waits_until = self._ready[0][0] + RELIEF_S
        if self._workers and (self._idle or now < waits_until):
            return max(waits_until, now + RELIEF_S / 2)
        try:
            self._begun(self._serve, "worker")
        except RuntimeError as exc:
            # The heartbeats go on; the system may have a thread later.
            self._refusals.note("", str(exc), "The reads of this process wait for a thread: %s", exc)
        else:
            self._workers += 1
            self._refusals.note("", "", "")
        return now + RELIEF_S

    def _serve(self) -> None:
        while (queue := self._next_queue()) is not None:
            self._run(queue.waiting.popleft())
            with self._lock:
                queue.busy = bool(queue.waiting)
                if queue.busy:
                    self._hand_over(queue, time.monotonic())

    def _next_queue(self) -> JobQueue | None:
        """Wait for a queue with work; None where enough wait."""
        with self._lock:
            while not self._ready:
                if self._idle or not self._jobs:
                    self._workers -= 1
                    return None
                self._idle += 1
                self._work.wait()
                self._idle -= 1
            return self._ready.popleft()[1]

    def _run(self, job: Job) -> None:
        with self._lock:
            if job.over:
                return
            job.runner = threading.current_thread()
        try:
            job.run()
        except Exception:
            job.failures += 1
            # A sensor that fails at 50 Hz must not fill the log.
            # One that goes on after its end finds what it needs closed.
            if job.failures & (job.failures - 1) == 0 and not job.over:
                logger.exception("%s failed (%d times).", job.name, job.failures)
        else:
            job.failures = 0
        finally:
            with self._lock:
                job.busy, job.runner = False, None
                self._finished.notify_all()


_timer = Timer()
_peers = count()

end_jobs = _timer.end


class Scheduler:
    """Jobs of one peer, at their rates from :meth:`start` to :meth:`stop`.

    Args:
        name: of the peer.
        timer: runs the jobs; the process's own by default.
    """

    def __init__(self, name: str, timer: Timer = _timer) -> None:
        self._name = name
        self._timer = timer
        self.phase = next(_peers) * SPREAD % 1 - 0.5
        self._lock = threading.Lock()
        self._jobs: dict[str, Job] = {}
        self._queues: dict[str, JobQueue] = {}
        self._running = False

    def every(self, name: str, hz: float, run: Callable[[], None], *, quick: bool = False, queue: str = "") -> None:
        """Run ``run`` ``hz`` times a second under ``name``; 0 or less is off.

        Args:
            quick: it never blocks, and runs on the timer.
            queue: jobs of the same queue run one after another, and delay no other queue.
        """
        with self._lock:
            former = self._jobs.pop(name, None)
            if former is not None:
                self._timer.remove([former])
            if hz > 0:
                own = None if quick else self._queues.setdefault(queue, JobQueue())
                period = max(MIN_PERIOD_S, 1.0 / hz)
                job = self._jobs[name] = Job(f"{self._name} {name}", period, run, own, self.phase)
                if self._running:
                    self._timer.add([job])

    def pace(self, name: str, hz: float, *, soon: bool = False) -> None:
        """Run a job ``hz`` times a second from now on; ``soon`` for the first time now."""
        with self._lock:
            job = self._jobs.get(name)
        if job is not None:
            self._timer.pace(job, max(MIN_PERIOD_S, 1.0 / hz), self.phase, soon=soon)

    def start(self) -> None:
        with self._lock:
            if not self._running:
                self._running = True
                self._timer.add(self._jobs.values())

    def stop(self, timeout: float) -> list[str]:
        """End the jobs within ``timeout`` s; return names of those still running."""
        with self._lock:
            self._running = False
            jobs = list(self._jobs.values())
            self._jobs.clear()
            self._timer.remove(jobs)
        return self._timer.wait(jobs, timeout)


def repeat(name: str, hz: float, run: Callable[[], None]) -> Callable[[], None]:
    """Run a quick job for all peers of the process.

    Returns:
        Its end, which waits for nothing.
    """
    scheduler = Scheduler(name)
    scheduler.every(name, hz, run, quick=True)
    scheduler.start()

    def end() -> None:
        scheduler.stop(0.0)

    return end
