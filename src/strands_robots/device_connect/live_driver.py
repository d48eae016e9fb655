"""A device's live state, told in one way everywhere: status, presence, heartbeat and state events.

The robot's reads run on threads (:mod:`.workers`), never on the event loop.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from device_connect_edge.drivers import DeviceDriver
from device_connect_edge.types import DeviceStatus, EventDef, FunctionDef

from strands_robots import settings
from strands_robots.contract import RolloutEvent, TaskRobot, Unsubscribe, WorldRobot
from strands_robots.device_connect.telemetry import RolloutPump, paced
from strands_robots.device_connect.workers import Lane
from strands_robots.envelope import jsonable

logger = logging.getLogger(__name__)

READ_DEADLINE_S = 5.0
"""Seconds in which a robot has to have answered a read."""

READS_AT_ONCE = 4

_FUNCTIONS: WeakKeyDictionary[type, tuple[FunctionDef, ...]] = WeakKeyDictionary()
_EVENTS: WeakKeyDictionary[type, tuple[EventDef, ...]] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True)
class Activity:
    """What a robot is doing now, as it is told in status, presence, heartbeat and ``stateUpdate``."""

    busy: bool = False
    facts: Mapping[str, Any] = field(default_factory=dict)
    fault: str = ""


class LiveDriver(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A robot whose state is told. Subclasses read it and name the events.

    Args:
        robot: what is served, behind its contract.
    """

    def __init__(self, robot: TaskRobot | WorldRobot) -> None:
        super().__init__()
        self.robot = robot
        self.runtime: Any = None
        self.reads = Lane("read", READS_AT_ONCE)
        self.activity = Activity()
        self.changed = asyncio.Event()
        self._rolling: set[str] = set()
        self._watchers: list[asyncio.Task[None]] = []
        self._unsubscribe: Unsubscribe | None = None

    def glance(self) -> Activity:
        """Ask the robot what it is doing. May block: runs on a thread."""
        raise NotImplementedError

    async def tell(self, activity: Activity) -> None:
        """Emit the state events of ``activity``."""
        raise NotImplementedError

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit what belongs to ``event``."""
        raise NotImplementedError

    @property
    def functions(self) -> list[FunctionDef]:
        """What can be called; read off a class once, not for each robot of a fleet."""
        if type(self) not in _FUNCTIONS:
            _FUNCTIONS[type(self)] = tuple(super().functions)
        return list(_FUNCTIONS[type(self)])

    @property
    def events(self) -> list[EventDef]:
        """What can be heard; read off a class once, too."""
        if type(self) not in _EVENTS:
            _EVENTS[type(self)] = tuple(super().events)
        return list(_EVENTS[type(self)])

    @property
    def status(self) -> DeviceStatus:
        """Live availability: busy (score 1.0) while something runs, else idle (0.0)."""
        activity = self.activity if self._watchers else self._look_now()
        return DeviceStatus(**_status_fields(activity))

    def heartbeat(self) -> dict[str, Any]:
        """What every heartbeat carries besides the id and the time."""
        return {**_status_fields(self.activity), "state": jsonable(self.activity.facts)}

    def set_device(self, device: Any) -> None:
        """Learn the runtime, which has this robot's id on the network."""
        super().set_device(device)
        self.runtime = device

    @property
    def peer_id(self) -> str:
        """The device's id on the network; before it has one, the robot's own name."""
        return str(getattr(self.runtime, "device_id", "") or self.robot.tool_name_str)

    def set_event_callback(self, callback: Callable[[str, dict[str, Any]], Any]) -> None:
        """Emit through ``callback`` on the loop of this call, from whatever thread or loop an event comes."""
        home = asyncio.get_running_loop()

        async def emit_at_home(name: str, payload: dict[str, Any]) -> None:
            clean = jsonable(payload)
            if asyncio.get_running_loop() is home:
                await callback(name, clean)
            else:
                await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(callback(name, clean), home))

        super().set_event_callback(emit_at_home)

    async def connect(self) -> None:
        """Start telling the state; the robot manages its own hardware connection."""
        if self.runtime is None or self._watchers:
            return
        self.changed = asyncio.Event()
        self.activity = await self._looked()
        pump = RolloutPump(self._on_rollout, settings.number("STRANDS_DC_STREAM_HZ"))
        self._unsubscribe = self.robot.subscribe(pump.observe)
        self._watchers = [asyncio.create_task(work) for work in (pump.run(), *self.watches())]

    def watches(self) -> list[Any]:
        """The coroutines that run while the device is connected."""
        idle, busy = settings.number("STRANDS_DC_STATE_HZ"), settings.number("STRANDS_DC_STATE_BUSY_HZ")
        # A robot may tell that a rollout began before its own status says so.
        return [paced(lambda: busy if self.activity.busy or self._rolling else idle, self._tell_state, self.changed)]

    async def disconnect(self) -> None:
        """Stop telling the state; the robot manages its own shutdown."""
        watchers, self._watchers = self._watchers, []
        if self._unsubscribe is not None:
            self._unsubscribe()
            self._unsubscribe = None
        for watcher in watchers:
            watcher.cancel()
        await asyncio.gather(*watchers, return_exceptions=True)

    async def _on_rollout(self, event: RolloutEvent) -> None:
        if event.kind == "started":
            self._rolling.add(event.robot)
        elif event.kind == "finished":
            self._rolling.discard(event.robot)
        await self.tell_rollout(event)
        if event.kind != "step":
            self.changed.set()

    async def refresh(self) -> Activity:
        """Ask the robot again; the answer is what status and presence say from now on."""
        activity = self.activity = await self._looked()
        # The runtime announces this very mapping in its presence.
        self.runtime.status.update(_status_fields(activity))
        return activity

    async def _tell_state(self) -> None:
        activity = await self.refresh()
        if not activity.fault:
            await self.tell(activity)

    async def _looked(self) -> Activity:
        try:
            return await self.reads.run(self.glance, READ_DEADLINE_S)
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is its state to tell
            fault = f"{type(exc).__name__}: {exc}"
            if fault != self.activity.fault:
                logger.warning("%s: its state cannot be read: %s", self.peer_id, fault)
            return Activity(self.activity.busy, self.activity.facts, fault)

    def _look_now(self) -> Activity:
        try:
            return self.reads.start(self.glance).result(1.0)
        except Exception as exc:  # noqa: BLE001 - a robot that cannot answer is shown with its fault
            return Activity(fault=f"{type(exc).__name__}: {exc}")


def _status_fields(activity: Activity) -> dict[str, Any]:
    return {
        "availability": "busy" if activity.busy else "idle",
        "busy_score": 1.0 if activity.busy else 0.0,
        "error_state": activity.fault or None,
    }
