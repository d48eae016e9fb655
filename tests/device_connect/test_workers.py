"""Threads for robot verbs: bounded for each robot, never behind one another, gone when idle."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest
from fixtures.waiting import eventually

from strands_robots.device_connect.workers import Lane, LaneFullError, WorkerPool


def test_calls_run_side_by_side_and_idle_threads_end() -> None:
    pool = WorkerPool(idle_s=0.05)
    lane = Lane("read", 16, pool)
    threads: list[threading.Thread] = []
    together = threading.Barrier(8)

    def meet() -> int:
        threads.append(threading.current_thread())
        return together.wait(20)

    done = [lane.start(meet) for _ in range(8)]
    assert sorted(each.result(20) for each in done) == list(range(8))
    assert len(set(threads)) == 8
    eventually(lambda: not any(thread.is_alive() for thread in threads))


def test_an_idle_thread_is_used_again() -> None:
    pool = WorkerPool(idle_s=60)
    lane = Lane("read", 4, pool)
    threads = set()
    for _ in range(20):
        threads.add(lane.start(threading.current_thread).result(20))
        eventually(lambda: pool._free == 1)
    assert len(threads) == 1


def test_no_job_is_lost_when_threads_end_and_start() -> None:
    pool = WorkerPool(idle_s=0.001)
    lane = Lane("read", 64, pool)
    for _ in range(200):
        assert [each.result(20) for each in [lane.start(lambda: 1) for _ in range(4)]] == [1] * 4
        time.sleep(0.001)


def test_a_full_lane_refuses_and_another_one_does_not() -> None:
    pool = WorkerPool(idle_s=0.05)
    lane, other = Lane("motion", 2, pool), Lane("stop", 1, pool)
    let_go = threading.Event()
    blocked = [lane.start(let_go.wait) for _ in range(2)]
    with pytest.raises(LaneFullError):
        lane.start(lambda: None)
    assert other.start(lambda: "stopped").result(20) == "stopped"
    let_go.set()
    assert all(each.result(20) for each in blocked)
    assert lane.start(lambda: "again").result(20) == "again"


async def test_a_call_that_does_not_return_keeps_its_slot_and_not_the_caller() -> None:
    lane = Lane("motion", 1, WorkerPool(idle_s=0.05))
    let_go = threading.Event()
    with pytest.raises(TimeoutError):
        await lane.run(let_go.wait, 0.05)
    with pytest.raises(LaneFullError):
        await lane.run(lambda: None, 20)
    let_go.set()
    await asyncio.to_thread(eventually, lambda: free(lane))
    assert await lane.run(lambda: 5, 20) == 5


async def test_an_exception_reaches_the_caller() -> None:
    def fail() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        await Lane("read", 1, WorkerPool(idle_s=0.05)).run(fail, 20)


def test_a_call_that_outlives_its_loop_hurts_nobody() -> None:
    lane = Lane("read", 1, WorkerPool(idle_s=0.05))
    let_go = threading.Event()

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await lane.run(let_go.wait, 0.01)

    asyncio.run(give_up())
    let_go.set()
    eventually(lambda: free(lane))


def free(lane: Lane) -> bool:
    try:
        return lane.start(lambda: True).result(20)
    except LaneFullError:
        return False
