"""Telemetry of a device: the events of a rollout."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable

from strands_robots.contract import RolloutEvent
from strands_robots.serving.rate_limiter import RateLimiter

logger = logging.getLogger(__name__)

PENDING_MAX = 2000
"""Steps that may wait for the event loop (40 s of one robot at 50 Hz); starts and ends are never dropped."""

CATCH_UP = 50.0
"""Steps that may pass at once after a pause: a simulation at 50 Hz catches up one second at most, and loses none."""

CATCH_UP_AT_START = 2.0
"""The same for a loop that has just started."""


def step_limiter(hz: float, clock: Callable[[], float] = time.monotonic) -> RateLimiter:
    """Return the limit on the steps of each robot, ``hz`` a second."""
    return RateLimiter(hz, burst=CATCH_UP, at_start=CATCH_UP_AT_START, clock=clock)


class RolloutPump:
    """Carries rollout events from control threads to one coroutine, in order.

    Args:
        deliver: awaited once for each event.
        stream_hz: steps of one robot that pass in a second; starts and ends all pass.
    """

    def __init__(self, deliver: Callable[[RolloutEvent], Awaitable[None]], stream_hz: float) -> None:
        self._deliver = deliver
        self._limiter = step_limiter(stream_hz)
        self._waiting: deque[RolloutEvent] = deque()
        self._lock = threading.Lock()
        self._loop = asyncio.get_running_loop()
        self._some = asyncio.Event()
        self._dropped = 0

    def observe(self, event: RolloutEvent) -> None:
        """Queue an event. Control thread; returns at once and never raises."""
        with self._lock:
            if event.kind == "step":
                if not self._limiter.admit(event.robot):
                    return
                if len(self._waiting) >= PENDING_MAX:
                    self._dropped += 1
                    return
            elif event.kind == "finished":
                self._limiter.forget(event.robot)
            self._waiting.append(event)
        with contextlib.suppress(RuntimeError):  # the loop closed before the robot noticed
            self._loop.call_soon_threadsafe(self._some.set)

    async def run(self) -> None:
        """Deliver until cancelled."""
        while True:
            await self._some.wait()
            self._some.clear()
            while self._waiting:
                with self._lock:
                    event = self._waiting.popleft()
                    dropped, self._dropped = self._dropped, 0
                if dropped:
                    logger.warning("%d streamStep events were dropped: the event loop is behind.", dropped)
                await self._deliver(event)
