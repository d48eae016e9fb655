"""Telemetry: rate, order and completeness of the events of a rollout."""

from __future__ import annotations

import asyncio
import threading

from fixtures.waiting import until
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.contract import RolloutEvent
from strands_robots.device_connect import telemetry
from strands_robots.device_connect.telemetry import CATCH_UP, RolloutPump, step_limiter


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def event(kind: str, step: int = 0, robot: str = "arm") -> RolloutEvent:
    return RolloutEvent(kind, robot, "wave", "mock", step)  # type: ignore[arg-type]


@given(st.lists(st.floats(0, 0.5), max_size=200), st.floats(1, 200))
def test_step_limiter_admits_the_rate_and_one_catch_up(gaps: list[float], hz: float) -> None:
    clock = Clock()
    limiter = step_limiter(hz, clock)
    passed = 0
    for gap in gaps:
        clock.now += gap
        passed += limiter.admit("arm")
    assert passed <= CATCH_UP + clock.now * hz + 1


def test_steady_loop_that_was_held_up_loses_no_step() -> None:
    clock = Clock()
    limiter = step_limiter(50.0, clock)
    passed = 0
    for step in range(1000):
        due = step / 50
        # Held up 0.3 s every 2 s, then catching up at once.
        held = due >= 1 and due % 2 < 0.3
        clock.now = max(clock.now, due if not held else due - due % 2 + 0.3)
        passed += limiter.admit("arm")
    assert passed == 1000


def test_fast_loop_passes_at_the_rate_from_its_start() -> None:
    clock = Clock()
    limiter = step_limiter(50.0, clock)
    passed = 0
    for step in range(1000):
        clock.now = step / 1000
        passed += limiter.admit("arm")
    assert 50 <= passed <= 53


async def test_starts_and_ends_are_never_dropped() -> None:
    delivered: list[RolloutEvent] = []

    over = asyncio.Event()

    async def deliver(each: RolloutEvent) -> None:
        delivered.append(each)
        if each.kind == "finished":
            over.set()

    pump = RolloutPump(deliver, 1e9)

    def robot() -> None:
        for number in range(telemetry.PENDING_MAX * 2):
            pump.observe(event("step", number))
        pump.observe(event("finished"))

    thread = threading.Thread(target=robot)
    thread.start()
    thread.join()
    running = asyncio.create_task(pump.run())
    await over.wait()
    running.cancel()
    steps = [each.step for each in delivered if each.kind == "step"]
    assert steps == list(range(telemetry.PENDING_MAX))


async def test_each_robot_has_its_own_rate() -> None:
    delivered: list[RolloutEvent] = []

    async def deliver(each: RolloutEvent) -> None:
        delivered.append(each)

    pump = RolloutPump(deliver, 50.0)
    for number in range(100):
        pump.observe(event("step", number, robot=f"arm-{number}"))
    running = asyncio.create_task(pump.run())
    await until(lambda: len(delivered) == 100)
    running.cancel()


def test_observer_never_raises_after_the_loop_is_gone() -> None:
    async def make() -> RolloutPump:
        return RolloutPump(_nothing, 50.0)

    asyncio.run(make()).observe(event("started"))


async def _nothing(each: RolloutEvent) -> None:
    """Deliver nowhere."""
