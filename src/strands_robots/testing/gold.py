"""Gold: the robot is as good the twentieth time, and after its cable was out."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from strands_robots.adapted import behind_contract
from strands_robots.contract import holds_robots
from strands_robots.errors import RefusalError
from strands_robots.fleet.reports import EventFeed
from strands_robots.testing.bench import (
    ConformanceBench,
    DriftError,
    NetworkBench,
    NotKeptError,
    NotProvenError,
    runs,
    wait_for,
)
from strands_robots.testing.promise import promise
from strands_robots.testing.raised import CABLE_OUT

STARTS = 20
WARM_UP = 3
"""Starts before the first count: what is made once is no leak."""

NOTICED_S = 0.3
"""A robot that tells no events of its own is looked at ten times a second: so long it stands before its next motion."""

READ_S = 1.0
DESCRIPTORS = Path("/proc/self/fd")
STALL_S = 0.5
"""Longest time for which the robot's code may keep every other thread from running."""


@promise(
    "gold.reads",
    "While it moves, each read without arguments is answered within a second, and what it declares itself.",
    why="Who watches a robot watches it while it moves.",
    look="a lock that the motion and get_state or get_task_status take",
    needs="silver.halts",
)
def reads(bench: ConformanceBench) -> str:
    """Read everything on each network during a motion."""
    slowest = 0.0
    with bench.moving() as run:
        for robot in bench.on.values():
            for verb in bench.plain_reads(robot.network):
                began = time.monotonic()
                try:
                    robot.call(verb.name, timeout=bench.answer_s(verb))
                except RefusalError as exc:
                    raise NotKeptError(f"{verb.name} on {robot.network} during a motion: {exc}") from exc
                took = time.monotonic() - began
                slowest = max(slowest, took)
                if took > READ_S + verb.lasts_s:
                    raise NotKeptError(f"{verb.name} on {robot.network} took {took:.1f} s during a motion")
        if not runs(bench.body):
            if bench.subject.recorder is not None:
                _check_says_running(bench, bench.writes)
            raise NotProvenError(f"{run.motion.verb} ended before everything was read")
    return f"slowest {slowest * 1000:.0f} ms"


def _check_says_running(bench: ConformanceBench, count: int) -> None:
    time.sleep(bench.subject.watch_s)
    if bench.writes > count and not runs(bench.body):
        raise DriftError("its status says that nothing runs while it writes to its bus")


@promise(
    "gold.threads_run",
    "Its start, its motion and its halt let the other threads of the process run.",
    why="Every robot of a process has its stops there; one that holds the interpreter holds all of them.",
    look="long loops of Python or C code without a wait; a start that computes",
    needs="silver.halts",
)
def threads_run(bench: ConformanceBench) -> str:
    """Measure the longest pause of a thread that wants to run all the time."""
    with _pauses() as longest:
        with bench.moving():
            time.sleep(0.2)
            bench.halt()
        pause = longest[0]
    if pause > STALL_S:
        raise NotKeptError(f"no other thread ran for {pause:.2f} s")
    return f"longest pause {pause * 1000:.0f} ms"


@contextmanager
def _pauses() -> Iterator[list[float]]:
    over, longest = threading.Event(), [0.0]

    def beat() -> None:
        last = time.monotonic()
        while not over.wait(0.005):
            now = time.monotonic()
            longest[0], last = max(longest[0], now - last), now

    thread = threading.Thread(target=beat, name="conform pauses", daemon=True)
    thread.start()
    try:
        yield longest
    finally:
        over.set()
        thread.join()


@promise(
    "gold.starts",
    f"{STARTS} motions, each halted, leave no thread and no open file behind.",
    why="A robot runs for weeks: one thread a start is a process that cannot start one for a stop.",
    look="threads, sockets and files that a start makes, and who ends them",
    needs="gold.threads_run",
)
def starts(bench: ConformanceBench) -> str:
    """Count threads and files before and after."""
    for _ in range(WARM_UP):
        _start_and_halt(bench)
    before = _settled_counts()
    for _ in range(STARTS):
        _start_and_halt(bench)
    deadline = time.monotonic() + bench.subject.answer_s
    after = _counts()
    # One thread may be on its way out, or stand ready in a pool.
    while _more(before, after) and time.monotonic() < deadline:
        time.sleep(0.05)
        after = _counts()
    if grown := _more(before, after):
        raise NotKeptError(f"{STARTS} starts left {grown}")
    return ", ".join(f"{count} {name}" for name, count in after.items())


def _start_and_halt(bench: ConformanceBench) -> None:
    with bench.moving():
        bench.halt()


def _settled_counts() -> dict[str, int]:
    last = _counts()
    for _ in range(20):
        time.sleep(0.05)
        now = _counts()
        if now == last:
            return now
        last = now
    return last


def _counts() -> dict[str, int]:
    files = len(list(DESCRIPTORS.iterdir())) if DESCRIPTORS.is_dir() else 0
    return {"threads": threading.active_count(), "open files": files}


def _more(before: dict[str, int], after: dict[str, int]) -> str:
    """Return what has grown by a third of the starts or more."""
    grown = {name: after[name] - before[name] for name in before if after[name] - before[name] >= STARTS // 3}
    return " and ".join(f"{count} {name}" for name, count in grown.items())


TASK_EVENTS = ("taskStarted", "taskComplete")
WORLD_EVENTS = ("policyStarted", "policyComplete")


@promise(
    "gold.events",
    "On Device Connect each motion has one taskStarted and then one taskComplete, which says how it ended; in a "
    "world policyStarted and policyComplete.",
    why="Agents and recordings follow a motion by its events; a second end is the end of another motion.",
    look="observers called twice, or never after a stop",
    needs="silver.halts",
)
def events(bench: ConformanceBench) -> str:
    """Follow the events of one motion that is halted once it was announced."""
    expected = WORLD_EVENTS if holds_robots(behind_contract(bench.body)) else TASK_EVENTS
    seen: list[str] = []
    time.sleep(NOTICED_S)
    with bench.remote.events(timeout=bench.subject.answer_s) as feed:
        following = _Following(feed, expected, seen)
        with bench.moving():
            following.until(expected[0], bench.subject.answer_s)
            bench.halt()
        if seen:
            following.until(expected[1], bench.subject.answer_s)
        following.until("", bench.subject.watch_s)
    if seen != list(expected):
        raise DriftError(f"the events of a halted motion were {', '.join(seen) or 'none'}")
    return ""


class _Following:
    """Notes the events of one kind; a robot may send others without a pause."""

    def __init__(self, feed: EventFeed, expected: Collection[str], seen: list[str]) -> None:
        self._feed, self._expected, self._seen = feed, expected, seen
        self._news = threading.Condition()
        threading.Thread(target=self._follow, name="conform events", daemon=True).start()

    def until(self, name: str, seconds: float) -> None:
        """Wait for an event of that name, at most so long."""
        with self._news:
            self._news.wait_for(lambda: name in self._seen, seconds)

    def _follow(self) -> None:
        for event in self._feed:
            if event.name in self._expected:
                with self._news:
                    self._seen.append(event.name)
                    self._news.notify_all()


@promise(
    "gold.recovers",
    "After its bus has failed in a motion, it moves and halts again.",
    why="A cable that was out for a second must not need a new process.",
    look="a thread that ended with an exception, a flag that stays set",
    needs_recorder=True,
    needs="silver.halts",
)
def recovers(bench: ConformanceBench) -> str:
    """Let the bus fail in a motion, then move again."""
    recorder = bench.subject.recorder
    assert recorder is not None
    with bench.moving() as run:
        with recorder.raising(OSError(5, CABLE_OUT)):
            time.sleep(0.2)
            bench.wait_for_fault()
        bench.halt()
        run.join()
    bench.check_fault_met("raises")
    wait_for(
        lambda: bench.halt().stopped is True,
        bench.subject.answer_s,
        "a halt that says stopped after the cable was back",
    )
    bench.check_moves_again("its cable was back")
    return ""


@promise(
    "gold.own_verbs",
    "Its own reads answer with the same fields on both networks.",
    why="A robot is a robot, near and far.",
    look="reads that look at who calls",
)
def own_verbs(bench: NetworkBench) -> str:
    """Compare the answers of both networks."""
    own = [each for each in bench.plain_reads(bench.remote.network) if each.own]
    for verb in own:
        answers = {name: robot.call(verb.name, timeout=bench.subject.answer_s) for name, robot in bench.on.items()}
        keys = {name: sorted(answer.keys() - {"content", "ok"}) for name, answer in answers.items()}
        if len({tuple(each) for each in keys.values()}) > 1:
            raise DriftError(f"{verb.name} answers other fields by network: {keys}")
    return ", ".join(each.name for each in own) or "it has none of its own"


PROMISES = (threads_run, reads, starts, events, recovers, own_verbs)
