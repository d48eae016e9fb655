"""Telemetry of a device: the events of a rollout, and the state of its robot, told when it changes.

A robot that does something is looked at through its own share of the workers, at the rate of its events. All robots of
a loop that do nothing are looked at by one worker in turn, which wakes the device of one that changed.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import operator
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Protocol, TypeVar

from strands_robots.contract import RolloutEvent
from strands_robots.serving.rate_limiter import RateLimiter
from strands_robots.serving.workers import UNBOUNDED, ShareFullError

logger = logging.getLogger(__name__)

T = TypeVar("T")

PENDING_MAX = 2000
"""Steps that may wait for the event loop (40 s of one robot at 50 Hz); starts and ends are never dropped."""

CATCH_UP = 50.0
"""Steps that may pass at once after a pause: a simulation at 50 Hz catches up one second at most, and loses none."""

CATCH_UP_AT_START = 2.0
"""The same for a loop that has just started."""

AGAIN_S = 10.0
"""Seconds after which an unchanged state is told again, unread, for listeners that came later or lost one."""


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


async def report_changes(
    look: Callable[[], Awaitable[T | None]],
    tell: Callable[[T], Awaitable[None]],
    *,
    rate: Callable[[bool], float],
    changed: asyncio.Event,
    most_hz: float,
    same: Callable[[T, T], bool] = operator.eq,
) -> None:
    """Report what ``look`` returns, whenever it is another one. Ends when cancelled.

    Args:
        look: returns the state, or None when there is none to tell.
        tell: tells it.
        rate: returns the looks a second, by whether the last one found a change; 0 to look when ``changed`` is set.
        changed: set from the loop for a look at once.
        most_hz: looks a second at most.
        same: returns True for two states of which the second one need not be told.
    """
    loop = asyncio.get_running_loop()
    reported: T | None = None
    due = loop.time()
    while True:
        changed.clear()
        began = loop.time()
        state = await look()
        moved = state is not None and (reported is None or not same(reported, state))
        if state is not None and moved:
            await tell(state)
        if state is None or moved:
            reported = state
        hz = rate(moved)
        if hz > 0:
            due = max(due + 1.0 / hz, loop.time())
            woken = await _set_within(changed, due - loop.time())
        else:
            while not (woken := await _set_within(changed, AGAIN_S)):
                if reported is not None:
                    await tell(reported)
        if woken:
            await asyncio.sleep(max(began + 1.0 / most_hz - loop.time(), 0.0))
            due = loop.time()


async def _set_within(event: asyncio.Event, seconds: float) -> bool:
    # Not wait_for: in Python 3.11 it forgets a cancellation that comes together with the event.
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await event.wait()
    return event.is_set()


class Watched(Protocol):
    """A robot that the sweep looks at while it does nothing."""

    @property
    def quiet(self) -> bool:
        """True while no other look at it is due."""

    def unchanged(self) -> bool:
        """Look at the robot, on a worker; False when its state is another one."""

    def wake(self) -> None:
        """Look at it properly, on its loop."""


class IdleSweep:
    """Looks at the quiet robots of one loop, one after the other on one worker.

    One that holds the worker from one turn to the next is woken, so that it is looked at by itself, and the others go
    on with another worker.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, hz: float) -> None:
        self._loop = loop
        self._every_s = 1.0 / hz
        self._robots: dict[int, Watched] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._turn = 0
        self._at: Watched | None = None
        self._at_last: Watched | None = None

    def add(self, robot: Watched) -> None:
        """Look at ``robot`` from now on."""
        self._robots[id(robot)] = robot
        if self._timer is None:
            self._timer = self._loop.call_later(self._every_s, self._begin)

    def remove(self, robot: Watched) -> None:
        """Look at ``robot`` no more; the last one ends the sweep."""
        self._robots.pop(id(robot), None)
        if not self._robots and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._turn += 1
            _SWEEPS.pop(self._loop, None)

    def _begin(self) -> None:
        self._timer = self._loop.call_later(self._every_s, self._begin)
        holding, before = self._at, self._at_last
        self._at_last = holding
        if holding is not None:
            if holding is not before:
                return
            holding.wake()
        self._turn += 1
        self._at = self._at_last = None
        quiet = [each for each in self._robots.values() if each.quiet and each is not holding]
        if quiet:
            with contextlib.suppress(ShareFullError):  # UNBOUNDED never is
                UNBOUNDED.submit(lambda turn=self._turn: self._look(quiet, turn))  # type: ignore[misc]

    def _look(self, robots: list[Watched], turn: int) -> None:
        """Look at each robot. On a worker."""
        for robot in robots:
            if turn != self._turn:
                return
            self._at = robot
            try:
                same = robot.unchanged()
            except Exception:  # noqa: BLE001 - the robot's own look finds and tells the fault
                same = False
            if turn != self._turn:
                return
            if not same:
                with contextlib.suppress(RuntimeError):  # the loop closed meanwhile
                    self._loop.call_soon_threadsafe(robot.wake)
        self._at = None


_SWEEPS: dict[asyncio.AbstractEventLoop, IdleSweep] = {}


def sweep(hz: float) -> IdleSweep:
    """Return the running loop's sweep; the first call sets its rate."""
    loop = asyncio.get_running_loop()
    if loop not in _SWEEPS:
        _SWEEPS[loop] = IdleSweep(loop, hz)
    return _SWEEPS[loop]
