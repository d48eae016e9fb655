"""A task that runs at once, and is a task in every other way."""

import asyncio
import contextvars

import pytest
from fixtures.waiting import until

from strands_robots.device_connect.backends.dispatch import start_now

NAME = contextvars.ContextVar("NAME", default="")


def at_once(work):
    """Start ``work`` from a plain callback, where no task runs."""
    started = asyncio.get_running_loop().create_future()

    def start():
        task = start_now(work)
        started.set_result((task, seen_at_start()))

    seen = []

    def seen_at_start():
        return list(seen)

    asyncio.get_running_loop().call_soon(start)
    return started, seen


async def test_what_does_not_wait_is_over_before_start_returns():
    async def work():
        seen.append("done")

    started, seen = at_once(coroutine := work())
    task, at_start = await started
    assert at_start == ["done"]
    assert await task is None
    assert coroutine.cr_frame is None


async def test_what_waits_goes_on_later():
    gate = asyncio.Event()

    async def work():
        seen.append(1)
        await gate.wait()
        seen.append(2)
        await asyncio.sleep(0)
        await asyncio.sleep(0.001)
        seen.append(3)

    started, seen = at_once(work())
    task, at_start = await started
    assert at_start == [1]
    gate.set()
    await task
    assert seen == [1, 2, 3]


async def test_a_bare_yield_comes_first():
    async def work():
        await asyncio.sleep(0)
        seen.append(1)

    started, seen = at_once(work())
    await (await started)[0]
    assert seen == [1]


async def test_it_is_the_current_task_from_the_first_step_on_so_that_timeouts_work():
    async def work():
        first = asyncio.current_task()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.01):
                await asyncio.sleep(5)
        seen.extend((first, asyncio.current_task()))

    started, seen = at_once(work())
    task, _ = await started
    await task
    assert seen == [task, task]


@pytest.mark.parametrize("wait_first", [False, True])
async def test_what_it_raises_is_the_tasks_outcome(wait_first):
    async def work():
        if wait_first:
            await asyncio.sleep(0.001)
        raise ValueError("broken")

    started, _ = at_once(work())
    task, _ = await started
    with pytest.raises(ValueError, match="broken"):
        await task


@pytest.mark.parametrize("let_it_run", [False, True])
async def test_cancelled_at_any_moment_it_ends_in_order_and_takes_what_it_waits_for_with_it(let_it_run):
    loop, seen = asyncio.get_running_loop(), []
    inner = loop.create_future()

    async def work():
        try:
            await inner
        finally:
            seen.append("cleaned up")

    def start():
        task = start_now(work())
        if let_it_run:
            loop.call_soon(loop.call_soon, task.cancel)
        else:
            task.cancel()
        seen.append(task)

    loop.call_soon(start)
    await until(lambda: "cleaned up" in seen)
    task = seen[0]
    await asyncio.wait({task})
    assert task.cancelled()
    assert inner.cancelled()


async def test_a_context_variable_set_inside_stays_inside_and_lasts():
    async def work():
        token = NAME.set("inside")
        await asyncio.sleep(0.001)
        seen.append(NAME.get())
        NAME.reset(token)

    started, seen = at_once(work())
    await (await started)[0]
    assert seen == ["inside"]
    assert NAME.get() == ""


async def test_inside_a_task_it_begins_in_the_next_turn():
    seen = []

    async def work():
        seen.append(asyncio.current_task())

    task = start_now(work())
    assert not seen
    await task
    assert seen == [task]
