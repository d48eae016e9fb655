"""States told when they change, and idle robots looked at in turn."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator

import pytest
from fixtures.waiting import until

from strands_robots.device_connect import telemetry
from strands_robots.device_connect.telemetry import IdleSweep, report_changes


class Counter:
    """A state that counts the looks at it."""

    def __init__(self) -> None:
        self.state: int | None = 0
        self.looks = 0
        self.told: list[tuple[float, int]] = []
        self.changed = asyncio.Event()
        self.hz = 0.0

    async def look(self) -> int | None:
        self.looks += 1
        return self.state

    async def tell(self, state: int) -> None:
        self.told.append((time.monotonic(), state))

    def report(self, most_hz: float = 100.0) -> asyncio.Task[None]:
        work = report_changes(self.look, self.tell, rate=lambda moved: self.hz, changed=self.changed, most_hz=most_hz)
        return asyncio.create_task(work)


async def test_unchanged_state_is_neither_told_nor_read_again() -> None:
    counter = Counter()
    task = counter.report()
    await until(lambda: counter.told)
    # Three wake-ups without a change.
    for looks in (2, 3, 4):
        counter.changed.set()
        await until(lambda looks=looks: counter.looks == looks)  # type: ignore[misc]
    task.cancel()
    assert [state for _, state in counter.told] == [0]


async def test_unchanged_state_is_told_again_unread_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(telemetry, "AGAIN_S", 0.01)
    counter = Counter()
    task = counter.report()
    await until(lambda: len(counter.told) >= 3)
    task.cancel()
    assert counter.looks == 1


async def test_changes_are_told_at_the_rate_at_most() -> None:
    counter = Counter()
    task = counter.report(most_hz=50.0)
    began = time.monotonic()
    while time.monotonic() < began + 0.3:
        assert counter.state is not None
        counter.state += 1
        counter.changed.set()
        await asyncio.sleep(0)
    task.cancel()
    assert 2 <= len(counter.told) <= 0.3 * 50 + 2


async def test_busy_state_is_looked_at_at_its_rate_and_missed_turns_are_left_out() -> None:
    counter = Counter()
    counter.hz = 50.0
    began = time.monotonic()
    task = counter.report()
    await until(lambda: counter.looks >= 20)
    task.cancel()
    assert counter.looks <= (time.monotonic() - began) * 50.0 + 2


async def test_state_that_could_not_be_read_is_told_when_it_is_back() -> None:
    counter = Counter()
    counter.hz = 100.0
    task = counter.report()
    await until(lambda: counter.told)
    counter.state = None
    looks = counter.looks
    await until(lambda: counter.looks > looks + 1)
    counter.state = 0
    await until(lambda: len(counter.told) == 2)
    task.cancel()


async def test_cancel_is_honoured_together_with_a_change() -> None:
    counter = Counter()
    task = counter.report()
    await until(lambda: counter.told)
    counter.changed.set()
    task.cancel()
    await asyncio.wait({task}, timeout=20)
    assert task.done()


class Robot:
    """A robot that the sweep looks at."""

    def __init__(self) -> None:
        self.quiet = True
        self.same = True
        self.looks: list[int] = []
        self.woken = 0
        self.held: threading.Event | None = None

    def unchanged(self) -> bool:
        self.looks.append(threading.get_ident())
        if self.held is not None:
            self.held.wait(30.0)
        return self.same

    def wake(self) -> None:
        self.woken += 1


@pytest.fixture
def robots() -> Iterator[list[Robot]]:
    made = [Robot() for _ in range(20)]
    yield made
    for each in made:
        if each.held is not None:
            each.held.set()


async def test_one_worker_looks_at_all_quiet_robots(robots: list[Robot]) -> None:
    looking = IdleSweep(asyncio.get_running_loop(), 20.0)
    robots[3].quiet = False
    for each in robots:
        looking.add(each)
    await until(lambda: all(each.looks for each in robots if each.quiet))
    for each in robots:
        looking.remove(each)
    assert robots[3].looks == []
    assert len({each.looks[0] for each in robots if each.quiet}) == 1
    assert not any(each.woken for each in robots)


async def test_changed_robot_is_woken_and_so_is_one_that_fails(robots: list[Robot]) -> None:
    looking = IdleSweep(asyncio.get_running_loop(), 20.0)
    robots[1].same = False

    def fail() -> bool:
        raise OSError("bus is gone")

    robots[2].unchanged = fail  # type: ignore[method-assign]
    for each in robots[:4]:
        looking.add(each)
    await until(lambda: robots[1].woken and robots[2].woken)
    for each in robots[:4]:
        looking.remove(each)
    assert not robots[0].woken
    assert not robots[3].woken


async def test_robot_that_blocks_is_woken_and_the_others_are_looked_at(robots: list[Robot]) -> None:
    looking = IdleSweep(asyncio.get_running_loop(), 20.0)
    robots[0].held = threading.Event()
    for each in robots[:3]:
        looking.add(each)
    await until(lambda: robots[0].woken)
    # Its own look is under way.
    robots[0].quiet = False
    await until(lambda: all(len(each.looks) >= 3 for each in robots[1:3]))
    for each in robots[:3]:
        looking.remove(each)
    assert len(robots[0].looks) == 1
