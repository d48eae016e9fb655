"""Threads for robot verbs: bounded for each robot, never behind one another, gone when idle."""

from __future__ import annotations

import asyncio
import gc
import threading
import time
import weakref

import pytest
from fixtures.waiting import eventually

from strands_robots.serving.workers import Share, ShareFullError, WorkerPool, called


def test_calls_run_side_by_side_and_idle_threads_end() -> None:
    pool = WorkerPool(idle_s=0.05)
    share = Share(16, 0, pool)
    threads: list[threading.Thread] = []
    together = threading.Barrier(8)

    def meet() -> int:
        threads.append(threading.current_thread())
        return together.wait(20)

    done = [share.call(meet) for _ in range(8)]
    assert sorted(each.result(20) for each in done) == list(range(8))
    assert len(set(threads)) == 8
    eventually(lambda: not any(thread.is_alive() for thread in threads))


def test_an_idle_thread_is_used_again() -> None:
    pool = WorkerPool(idle_s=60)
    share = Share(4, 0, pool)
    threads = set()
    for _ in range(20):
        threads.add(share.call(threading.current_thread).result(20))
        eventually(lambda: pool.idle == 1)
    assert len(threads) == 1


def test_idle_thread_keeps_nothing_of_the_call_that_started_it() -> None:
    pool = WorkerPool(idle_s=60.0)
    robot = threading.Event()
    left = weakref.ref(robot)
    Share(pool=pool).call(robot.set).result(20.0)
    eventually(lambda: pool.idle == 1)
    del robot
    eventually(lambda: gc.collect() >= 0 and left() is None, what="the end of the robot")
    assert pool.idle == 1


def test_no_job_is_lost_when_threads_end_and_start() -> None:
    pool = WorkerPool(idle_s=0.001)
    share = Share(64, 0, pool)
    for _ in range(200):
        assert [each.result(20) for each in [share.call(lambda: 1) for _ in range(4)]] == [1] * 4
        time.sleep(0.001)


def test_a_full_share_refuses_and_another_one_does_not() -> None:
    pool = WorkerPool(idle_s=0.05)
    share, other = Share(2, 0, pool), Share(1, 0, pool)
    let_go = threading.Event()
    blocked = [share.call(let_go.wait) for _ in range(2)]
    with pytest.raises(ShareFullError):
        share.call(lambda: None)
    assert other.call(lambda: "stopped").result(20) == "stopped"
    let_go.set()
    assert all(each.result(20) for each in blocked)
    assert share.call(lambda: "again").result(20) == "again"


async def test_a_call_that_does_not_return_keeps_its_slot_and_not_the_caller() -> None:
    share = Share(1, 0, WorkerPool(idle_s=0.05))
    let_go = threading.Event()
    with pytest.raises(TimeoutError):
        await called(share, let_go.wait, 0.05)
    with pytest.raises(ShareFullError):
        await called(share, lambda: None, 20)
    let_go.set()
    await asyncio.to_thread(eventually, lambda: free(share))
    assert await called(share, lambda: 5, 20) == 5


async def test_an_exception_reaches_the_caller() -> None:
    def fail() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        await called(Share(1, 0, WorkerPool(idle_s=0.05)), fail, 20)


def test_a_call_that_outlives_its_loop_hurts_nobody() -> None:
    share = Share(1, 0, WorkerPool(idle_s=0.05))
    let_go = threading.Event()

    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await called(share, let_go.wait, 0.01)

    asyncio.run(give_up())
    let_go.set()
    eventually(lambda: free(share))


def free(share: Share) -> bool:
    try:
        return share.call(lambda: True).result(20)
    except ShareFullError:
        return False


def test_call_that_no_thread_can_be_started_for_runs_here_and_gives_its_turn_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    share = Share(1, 1, WorkerPool(idle_s=0.05))
    monkeypatch.setattr(threading.Thread, "start", refuse)
    for _ in range(3):
        assert share.call(threading.get_ident).result(0) == threading.get_ident()


def test_call_that_ends_in_a_panic_gives_its_turn_back() -> None:
    share = Share(1, 0, WorkerPool(idle_s=0.05))

    def panic() -> None:
        raise SystemExit

    for _ in range(3):
        share.submit(panic)
        eventually(lambda: free(share))
