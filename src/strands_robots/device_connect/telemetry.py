"""Telemetry of a device: events of rollouts, and its robot's state on change.

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
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

from strands_robots import settings
from strands_robots.contract import Robot, RolloutEvent
from strands_robots.device_connect._compat import describe_anew
from strands_robots.device_connect.presence import lock_stated
from strands_robots.policies.base import plain_numbers
from strands_robots.rate_limits import RateLimiter
from strands_robots.serving.offered_verbs import Offers
from strands_robots.serving.pipeline import Pipeline
from strands_robots.serving.workers import UNBOUNDED, ShareFullError, called

logger = logging.getLogger(__name__)

T = TypeVar("T")

PENDING_MAX = 2000
"""Steps that may wait for the event loop (40 s of one robot at 50 Hz); starts and ends are never dropped."""

CATCH_UP = 50.0
"""Steps that may pass at once after a pause: a simulation at 50 Hz catches up one second at most, and loses none."""

CATCH_UP_AT_START = 2.0
"""The same for a loop that has just started."""

READ_DEADLINE_S = 5.0
"""Seconds in which a robot has to have answered a read."""

FIRST_LOOK_S = 0.02
"""Seconds from the start of a device to its first state."""

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


def rollout_fields(event: RolloutEvent) -> dict[str, Any]:
    """Return what a device tells of an event of a rollout."""
    if event.kind == "started":
        return {
            "instruction": event.instruction,
            "policy_provider": event.policy,
            "follows_instruction": event.follows_instruction,
        }
    if event.kind == "step":
        observation, action = plain_numbers(event.observation), plain_numbers(event.action)
        return {"step": event.step, "observation": observation, "action": action, "led_by": event.led_by}
    if event.kind == "turn":
        return {"state": event.state, "leader": event.led_by, "why": event.error}
    return {
        "instruction": event.instruction,
        "steps": event.step,
        "state": event.state,
        "error": event.error,
        "loop": dict(event.loop),
    }


@dataclass(frozen=True, slots=True)
class Activity:
    """Present activity of a robot, as status, presence and events report it.

    Attributes:
        joints: of each robot of a world, which events of their own tell.
    """

    busy: bool = False
    facts: Mapping[str, Any] = field(default_factory=dict)
    fault: str = ""
    joints: Mapping[str, dict[str, float]] = field(default_factory=dict, compare=False)


class ReportedDevice(Protocol):
    """A driver whose robot's activity is reported."""

    robot: Robot
    runtime: Any
    offers: Offers
    pipeline: Pipeline

    @property
    def peer_id(self) -> str:
        """The device's id on the network."""

    def glance(self) -> Activity:
        """Ask the robot for its activity. May block: runs on a thread."""

    def same(self, one: Activity, other: Activity) -> bool:
        """Return True for two activities of which the second one need not be told."""

    def status_of(self, activity: Activity) -> dict[str, Any]:
        """Return the fields of the device's status."""

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit the events that belong to ``event``."""


class StateReports:
    """The activity of one device's robot: read on threads, told when it changes."""

    def __init__(self, device: Any) -> None:
        self._device: ReportedDevice = device
        self.activity = Activity()
        """As it was read last."""
        self._read = False
        self._changed: list[asyncio.Event] = []
        self._looking = 0
        self._rolling: set[str] = set()

    @property
    def present(self) -> Activity:
        """The activity as it was read last; before the first look it is read now."""
        if self._read:
            return self.activity
        try:
            return self._device.pipeline.shares.read.call(self._device.glance).result(1.0)
        except Exception as exc:  # noqa: BLE001 - a robot that cannot answer is shown with its fault
            return Activity(fault=f"{type(exc).__name__}: {exc}")

    @property
    def quiet(self) -> bool:
        """True while the robot does nothing and is not being looked at."""
        return not (self.activity.busy or self._rolling or self.activity.fault or self._looking)

    def unchanged(self) -> bool:
        """Look at the robot, on a worker; False when its state, verbs or lock are others."""
        device = self._device
        if not lock_stated(device).items() <= device.runtime.status.items():
            return False
        activity = device.glance()
        same = device.same(activity, self.activity) and activity.joints == self.activity.joints
        return same and not device.robot.gate.under_way and not device.offers.look()

    def wake(self) -> None:
        """Look at the robot at once; on the loop."""
        for changed in self._changed:
            changed.set()

    def watch(
        self,
        look: Callable[[], Awaitable[T | None]],
        tell: Callable[[T], Awaitable[None]],
        same: Callable[[T, T], bool],
        busy_hz: float,
        moving_hz: float,
    ) -> Coroutine[Any, Any, None]:
        """Return a watch that tells a state whenever it changed.

        Args:
            look: reads the state; None when it cannot be read.
            tell: emits it.
            same: returns True for two states of which the second one need not be told.
            busy_hz: looks a second while something runs.
            moving_hz: the same while nothing runs and the state changes nevertheless.
        """
        idle_hz, changed = settings.number("STRANDS_DC_STATE_HZ"), asyncio.Event()
        self._changed.append(changed)

        def rate(moved: bool) -> float:
            # A robot may tell that a rollout began before its own status says so.
            if self.activity.busy or self._rolling:
                return busy_hz
            # A quiet robot is looked at by the sweep.
            return moving_hz if moved else idle_hz if self.activity.fault else 0.0

        async def after_the_start() -> None:
            # The first look costs the start of the device nothing.
            await asyncio.sleep(FIRST_LOOK_S)
            await report_changes(look, tell, rate=rate, changed=changed, most_hz=busy_hz, same=same)

        return after_the_start()

    async def look(self) -> Activity | None:
        """Ask the robot again; None where it cannot be read."""
        activity = await self.refresh()
        return None if activity.fault else activity

    async def read(self) -> None:
        """Ask the robot for its activity, once until :meth:`end`."""
        if not self._read:
            self.activity = await self._looked()
            self._read = True

    async def refresh(self) -> Activity:
        """Ask the robot again; the answer is what status and presence say from now on."""
        activity = self.activity = await self._looked()
        # The runtime announces this very mapping in its presence.
        self._device.runtime.status.update(self._device.status_of(activity))
        describe_anew(self._device.runtime, self._device)
        return activity

    async def on_rollout(self, event: RolloutEvent) -> None:
        """Tell an event of a rollout, and look at the robot where one began or ended."""
        if event.kind == "started":
            self._rolling.add(event.robot)
        elif event.kind == "finished":
            self._rolling.discard(event.robot)
        await self._device.tell_rollout(event)
        if event.kind != "step":
            self.wake()

    def end(self) -> None:
        """Forget the watches; the next status asks the robot."""
        self._changed, self._read = [], False

    async def _looked(self) -> Activity:
        def glance() -> Activity:
            device.offers.look()
            return device.glance()

        device, self._looking = self._device, self._looking + 1
        try:
            activity = await called(device.pipeline.shares.read, glance, READ_DEADLINE_S)
            # A verb of its own and a leader are no task, and move it all the same.
            return replace(activity, busy=True) if device.robot.gate.under_way or self._rolling else activity
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is its state to tell
            fault = f"{type(exc).__name__}: {exc}"
            if fault != self.activity.fault:
                logger.warning("%s: its state cannot be read: %s", device.peer_id, fault)
            return replace(self.activity, fault=fault)
        finally:
            self._looking -= 1
