"""Reports of a stop: verdicts, stored lockouts, records; never on its way.

One thread turns three things into reports: a halt's answer, the lockout file being written, and time. It waits for
nothing else: the file is written by a thread of its own, and the audit has its own.
"""

from __future__ import annotations

import contextlib
import queue
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from strands_robots.safety.orders import RobotReport, StopOrder
from strands_robots.safety.stopping import StopVerdict
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

GRACE_S = 0.03
"""Lockouts are written when every robot has answered, or after this long: a slow halt delays only its own report."""

UNPACED = 32
"""Robots of a process that answer as soon as they have halted."""

PACE_S = 0.001
"""Seconds for each robot of a larger process until its lockouts are written.

Its robots answer *stopped* after that time, and as much again by chance. Other processes of the machine still halt
theirs meanwhile. Bad news waits for neither, but for the lockout file as any answer."""

PACE_MAX_S = 0.1
"""The longest of these times; with the chance, an answer is held back for twice as long at most."""

GATHER_S = 0.02
"""Seconds between two looks at the answers that come in before any of them goes out."""

KEEP_S = 0.7
"""Seconds that a report waits for the lockout file before it says ``persisted: false``.

When the file is written later, the robot is reported again."""

OnReport = Callable[[RobotReport], None]
OnDone = Callable[["StopRun"], None]


class StopRun:
    """One emergency stop on its way through the robots of this process.

    Args:
        kept_ids: robots whose lockout is kept.
        keep: writes the lockout file.
        on_halted: called once every halt has answered, or no longer needs an interpreter of its own.
    """

    def __init__(  # noqa: PLR0917 - one value of the stop each
        self,
        order: StopOrder,
        robot_ids: tuple[str, ...],
        kept_ids: frozenset[str],
        deadline_s: float,
        epochs_of: Callable[[str], tuple[str, ...]],
        on_report: OnReport,
        on_done: OnDone,
        keep: Callable[[], None],
        on_halted: Callable[[], None] = lambda: None,
    ) -> None:
        self.order, self.robot_ids, self.kept_ids, self.deadline_s = order, robot_ids, kept_ids, deadline_s
        self.epochs_of, self.on_report, self.on_done, self.keep = epochs_of, on_report, on_done, keep
        self.on_halted = on_halted
        self.reports: dict[str, RobotReport] = {}
        self.answers: dict[str, tuple[StopVerdict, float]] = {}
        self.halted: set[str] = set()
        self.done = threading.Event()
        self.keeping_since: float | None = None
        self.kept: bool | None = None
        count = len(robot_ids)
        pace_s = min(PACE_S * count, PACE_MAX_S) if count > UNPACED else 0.0
        self.started = time.monotonic()
        self.keep_at = self.started + pace_s
        self.answer_at = self.started + pace_s * random.uniform(1.0, 2.0)

    def wait(self, timeout: float) -> bool:
        """True when every robot has been reported."""
        return self.done.wait(timeout)


@dataclass(frozen=True, slots=True)
class _Answer:
    run: StopRun
    robot_id: str
    verdict: StopVerdict
    at: float


@dataclass(frozen=True, slots=True)
class _Kept:
    run: StopRun
    ok: bool


class Reporter:
    """Reporting thread and file writer, made with the first robot.

    Args:
        tick: called about every ``tick_s`` seconds on the reporting thread, for what is due by time alone.
        chore: called about every ``chore_s`` seconds on the thread that writes, for what touches the disk.
    """

    def __init__(
        self,
        tick: Callable[[], None] = lambda: None,
        chore: Callable[[], None] = lambda: None,
        *,
        tick_s: float = 0.1,
        chore_s: float = 0.3,
    ) -> None:
        self._inbox: queue.SimpleQueue[StopRun | _Answer | _Kept | None] = queue.SimpleQueue()
        self._files: queue.SimpleQueue[StopRun | None] = queue.SimpleQueue()
        self._runs: list[StopRun] = []
        self._tick = tick
        self._tick_s = tick_s
        self._chore, self._chore_s = chore, chore_s
        self._threads = [
            threading.Thread(target=self._run, name="safety-report", daemon=True),
            threading.Thread(target=self._write, name="safety-keep", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def begin(self, run: StopRun) -> None:
        """Follow ``run`` to its end."""
        self._inbox.put(run)

    def answer(self, run: StopRun, robot_id: str, verdict: StopVerdict) -> None:
        """Record the verdict of a halt."""
        run.halted.add(robot_id)
        if len(run.halted) == len(run.robot_ids):
            # Here, because the reporting thread may be sending the answers to another stop.
            run.on_halted()
        self._inbox.put(_Answer(run, robot_id, verdict, time.monotonic()))

    def close(self) -> None:
        """End both threads; what is still unreported is reported as unanswered first."""
        self._inbox.put(None)
        self._files.put(None)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(1.0)

    def _run(self) -> None:
        next_tick = time.monotonic() + self._tick_s
        while self._take():
            if time.monotonic() >= next_tick:
                next_tick = time.monotonic() + self._tick_s
                _call(self._tick)
            for run in list(self._runs):
                self._advance(run, time.monotonic())
        for run in list(self._runs):
            self._time_out(run)

    def _take(self) -> bool:
        """Return everything that has arrived; False to end."""
        with contextlib.suppress(queue.Empty):  # all taken, or it is time to look at the clock
            message = self._inbox.get(timeout=self._patience())
            if message is not None and not isinstance(message, StopRun) and self._pacing():
                # One look for many halts: a thread that wakes for each takes time from the next one.
                time.sleep(GATHER_S)
            while True:
                if message is None:
                    return False
                if isinstance(message, StopRun):
                    self._runs.append(message)
                elif isinstance(message, _Answer):
                    self._answered(message)
                else:
                    self._keep_ended(message)
                message = self._inbox.get_nowait()
        return True

    def _patience(self) -> float:
        return min([self._tick_s, *(0.01 for _ in self._runs)])

    def _pacing(self) -> bool:
        return any(time.monotonic() < run.answer_at for run in self._runs)

    def _answered(self, answer: _Answer) -> None:
        run = answer.run
        late = run.reports.get(answer.robot_id)
        run.answers[answer.robot_id] = (answer.verdict, answer.at)
        if late is not None:
            logger.warning("%s answered its halt late: stopped=%s.", answer.robot_id, answer.verdict.stopped)
            self._report(run, answer.robot_id, late=True)

    def _keep_ended(self, kept: _Kept) -> None:
        run = kept.run
        late, run.kept = run.kept is False and kept.ok, kept.ok
        for robot_id in run.kept_ids if late else ():
            if robot_id in run.reports:
                logger.warning("%s: its lockout is on the disk now.", robot_id)
                self._report(run, robot_id, late=True)

    def _advance(self, run: StopRun, now: float) -> None:
        if run.keeping_since is None and self._halted(run, now):
            run.keeping_since = now
            run.on_halted()
            self._files.put(run)
        if run.keeping_since is not None and run.kept is None and now - run.keeping_since > KEEP_S:
            run.kept = False
        if run.kept is not None:
            for robot_id in run.robot_ids:
                if robot_id in run.answers and robot_id not in run.reports and self._due(run, robot_id, now):
                    self._report(run, robot_id)
        if len(run.reports) == len(run.robot_ids):
            self._finish(run)

    def _halted(self, run: StopRun, now: float) -> bool:
        """Return True when what follows delays no halt, here or in another process."""
        if now < run.keep_at and all(verdict.stopped for verdict, _ in run.answers.values()):
            return False
        return now - run.started >= GRACE_S or all(each in run.answers for each in run.robot_ids)

    def _due(self, run: StopRun, robot_id: str, now: float) -> bool:
        """Return False for good news before its moment."""
        return now >= run.answer_at or run.answers[robot_id][0].stopped is not True

    def _time_out(self, run: StopRun) -> None:
        """Report the rest as unanswered: the reporter ends before the executor answers."""
        run.on_halted()
        for robot_id in run.robot_ids:
            if robot_id not in run.reports:
                why = {robot_id: f"no answer in {run.deadline_s:g} s"}
                run.answers.setdefault(robot_id, (StopVerdict(not_stopped=why), time.monotonic()))
                self._report(run, robot_id)

    def _report(self, run: StopRun, robot_id: str, *, late: bool = False) -> None:
        verdict, at = run.answers[robot_id]
        persisted = bool(run.kept) if robot_id in run.kept_ids else None
        report = RobotReport(
            robot_id,
            run.order.epoch,
            verdict,
            run.epochs_of(robot_id),
            (at - run.order.received) * 1000,
            persisted=persisted,
            late=late,
            sent_at=run.order.issued,
            received_at=run.order.received_at,
            scope=run.order.scope,
        )
        run.reports[robot_id] = report
        if report.stopped is not True:
            logger.critical(
                "%s did not confirm emergency stop %s of %s: not stopped %s, unknown %s.",
                robot_id,
                run.order.epoch,
                run.order.source,
                dict(verdict.not_stopped),
                dict(verdict.unknown),
            )
        if persisted is False:
            logger.critical("%s is locked, but its lockout is not on the disk: a restart would forget it.", robot_id)
        _call(run.on_report, report)

    def _finish(self, run: StopRun) -> None:
        self._runs.remove(run)
        run.done.set()
        _call(run.on_done, run)

    def _write(self) -> None:
        due = time.monotonic() + self._chore_s
        while True:
            if time.monotonic() >= due:
                due = time.monotonic() + self._chore_s
                _call(self._chore)
            try:
                run = self._files.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                continue
            if run is None:
                return
            try:
                run.keep()
            except OSError as exc:
                logger.critical("The lockout file was not written: %s.", exc)
                self._inbox.put(_Kept(run, ok=False))
            except Exception:
                logger.critical("The lockout file was not written.", exc_info=True)
                self._inbox.put(_Kept(run, ok=False))
            else:
                self._inbox.put(_Kept(run, ok=True))


def _call(listener: Callable[..., None], *args: object) -> None:
    try:
        listener(*args)
    except Exception:
        logger.critical("A listener of a stop's report raised.", exc_info=True)


SOURCES_NAMED = 16


class StopCount:
    """Stops that were counted instead of carried out one by one; thread-safe.

    Args:
        every_s: seconds between two records of them.
    """

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s = every_s
        self._counting = threading.Lock()
        self._stops = 0
        self._sources: set[str] = set()
        self._due_at = float("-inf")

    def add(self, source: str) -> None:
        """Count one stop of ``source``."""
        with self._counting:
            self._stops += 1
            if len(self._sources) < SOURCES_NAMED:
                self._sources.add(source[:256])

    def take(self, now: float) -> dict[str, Any] | None:
        """Return the facts to record, and count anew; None when nothing is due."""
        with self._counting:
            if not self._stops or now < self._due_at:
                return None
            facts = {"stops": self._stops, "some_sources": sorted(self._sources)}
            self._stops, self._sources, self._due_at = 0, set(), now + self._every_s
            return facts
