"""Presence of devices: what they announce, their heartbeat, and other devices.

One message a second tells which devices of a loop and a link live. It is a heartbeat of the first of them, on whose
topic access rules let them publish, with the ids of all in ``devices``. A reader of heartbeats that does not know the
field sees one more heartbeat.

The framework's runtime parses the presence of every device for each device that it serves, which costs the square of
their number. Here the devices of one loop and one link share a collector, which runs while one of them needs it: for
``list_devices``, ``wait_for_device``, ``depends_on``, ``@on(device_type=...)`` and the lifecycle events.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from device_connect_edge.messaging.exceptions import MessagingError

from strands_robots.bounded_json import json_object
from strands_robots.device_connect.backends import LinkConfig, open_client

if TYPE_CHECKING:
    from device_connect_edge.drivers import DeviceDriver

logger = logging.getLogger(__name__)

PROCESS_HEARTBEAT_S = 1.0
"""Seconds between two heartbeats of a process."""

HEARTBEAT_S = 5.0
"""Seconds between two heartbeats of a single device, by the framework's default."""

MARK = b'"devices"'
"""Part of every heartbeat of a process; one without it is that of one device."""

KEEP_S = 60.0
"""Seconds that the collector goes on after the last question of a device."""

SETTLE_S = 0.5
"""Seconds after its start in which the collector has the answers to its first probe."""

POLL_S = 0.02
"""Seconds between two looks for a device that the collector may still hear of."""

OnPeer = Callable[[str], Any]
Presence = dict[str, Any]


def encoded_capabilities(driver: DeviceDriver) -> str:
    """Return the capabilities of a driver as JSON.

    Raises:
        TypeError, ValueError: JSON cannot carry them.
    """
    described = getattr(driver, "described", None)
    return str(described()) if callable(described) else json.dumps(driver.capabilities.model_dump(), allow_nan=False)


def lock_stated(driver: object) -> dict[str, bool]:
    """Return what a device announces of its lockout; empty where it states none."""
    locked = getattr(driver, "locked_out", None)
    return {"locked": locked} if isinstance(locked, bool) else {}


def presence_builder(
    device_id: str, capabilities: Callable[[], str], identity: Presence, status: Callable[[], Mapping[str, Any]]
) -> Callable[[], bytes]:
    """Return a builder of presence messages that encodes nothing but the status.

    Args:
        device_id: whose presence.
        capabilities: returns them in JSON, as they are described now.
        identity: stays as it is.
        status: returns it, for each message anew.
    """
    device, stated = json.dumps(device_id), json.dumps(identity)

    def build() -> bytes:
        now = time.time()
        changing = {
            "status": {**status(), "ts": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(now))},
            "ts": now,
            "d2d": True,
        }
        described = f'{{"device_id": {device}, "capabilities": {capabilities()}, "identity": {stated}'
        return f"{described}, {json.dumps(changing)[1:]}".encode()

    return build


@dataclass(frozen=True, slots=True)
class LivingDevice:
    """One device of a process's heartbeat.

    Attributes:
        device_id: its id.
        messaging: its connected client.
        lives: returns False while its robot cannot be read; the heartbeat leaves it out then.
        fields: returns what a heartbeat of this device carries.
    """

    device_id: str
    messaging: Any
    lives: Callable[[], bool]
    fields: Callable[[], Mapping[str, Any]]


class ProcessHeartbeat:
    """The heartbeat of one loop and one link: which of their devices live."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = link
        self._devices: dict[str, LivingDevice] = {}
        self._task: asyncio.Task[None] | None = None

    def join(self, device: LivingDevice) -> None:
        """Name ``device`` from now on."""
        self._devices[device.device_id] = device
        if self._task is None:
            self._task = asyncio.create_task(self._run(), name="process-heartbeat")

    def leave(self, device: LivingDevice) -> None:
        """Name ``device`` no more; the last one ends the heartbeat."""
        if self._devices.get(device.device_id) is device:
            del self._devices[device.device_id]
        if not self._devices and self._task is not None:
            self._task.cancel()
            self._task = None
            _HEARTBEATS.pop((asyncio.get_running_loop(), self._link), None)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            await self._send()
            due = max(due + PROCESS_HEARTBEAT_S, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _send(self) -> None:
        living = [each for each in self._devices.values() if each.lives()]
        if not living:
            return
        first = living[0]
        try:
            message = {"device_id": first.device_id, "ts": time.time(), **first.fields()}
            message["devices"] = [each.device_id for each in living]
            await first.messaging.publish(
                f"device-connect.{self._link.tenant}.{first.device_id}.heartbeat", json.dumps(message).encode()
            )
        except (MessagingError, TypeError, ValueError) as exc:
            # Without a link there is no reader; the device's own heartbeat reports a state that cannot be sent.
            logger.debug("a heartbeat was not sent: %s", exc)


_HEARTBEATS: dict[tuple[asyncio.AbstractEventLoop, LinkConfig], ProcessHeartbeat] = {}


def process_heartbeat(link: LinkConfig) -> ProcessHeartbeat:
    """Return the running loop's heartbeat on ``link``."""
    return _HEARTBEATS.setdefault((asyncio.get_running_loop(), link), ProcessHeartbeat(link))


def devices_in(data: bytes) -> Iterable[str]:
    """Return the devices in a process's heartbeat; none for that of one device."""
    if MARK not in data:
        return ()
    devices = json_object(data).get("devices")
    return [each for each in devices if isinstance(each, str)] if isinstance(devices, list) else ()


class _SharedCollector:
    """The collector of one loop and one link."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = link
        self._users = 0
        self._changing = asyncio.Lock()
        self._client: Any = None
        self._collector: Any = None
        self.settled_at = 0.0

    async def enter(self) -> Any:
        """Return the running collector; started by the first user."""
        async with self._changing:
            self._users += 1
            if self._collector is None:
                # A reader of heartbeats, which has no device, does not load what this loads.
                from device_connect_edge.discovery import PresenceCollector  # noqa: PLC0415

                try:
                    self._client = await open_client(self._link)
                    collector = PresenceCollector(self._client, self._link.tenant)
                    await collector.start()
                    await collector.send_discovery_probe()
                except BaseException:
                    await self._leave()
                    raise
                self._collector = collector
                self.settled_at = asyncio.get_running_loop().time() + SETTLE_S
            return self._collector

    async def leave(self) -> None:
        """End one use; the last one ends the collector."""
        async with self._changing:
            await self._leave()

    async def _leave(self) -> None:
        self._users -= 1
        if self._users:
            return
        collector, self._collector = self._collector, None
        client, self._client = self._client, None
        if collector is not None:
            await collector.stop()
        if client is not None:
            await client.close()
        _SHARED.pop((asyncio.get_running_loop(), self._link), None)


_SHARED: dict[tuple[asyncio.AbstractEventLoop, LinkConfig], _SharedCollector] = {}


class PresenceView:
    """Other devices as one sees them, in place of the framework's collector.

    Args:
        link: where the devices are.
        device_id: the device that asks; it does not see itself.
    """

    # The runtime starts no collector that says that it was started, and sets this listener to announce itself more
    # often for a newcomer, who asks by a probe anyway.
    _started = True
    _on_new_peer: OnPeer | None = None

    def __init__(self, link: LinkConfig, device_id: str) -> None:
        self._link = link
        self._device_id = device_id
        self._entering = asyncio.Lock()
        self._shared: _SharedCollector | None = None
        self._collector: Any = None
        self._asked_at = 0.0
        self._listens = False
        self._letting_go: asyncio.Task[None] | None = None
        self._replays: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Do nothing: the collector starts with the first question."""

    async def stop(self) -> None:
        """End the use of the collector."""
        tasks = [*self._replays, *([self._letting_go] if self._letting_go is not None else ())]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._leave()

    def add_on_new_peer(self, callback: OnPeer) -> None:
        """Have ``callback(device_id)`` called for every device, present ones first."""
        self._listen(lambda collector: collector.add_on_new_peer(self._others(callback)), replayed=callback)

    def add_on_peer_removed(self, callback: OnPeer) -> None:
        """Have ``callback(device_id)`` called for every device that goes."""
        self._listen(lambda collector: collector.add_on_peer_removed(self._others(callback)))

    async def list_devices(self, *, device_type: str | None = None, location: str | None = None) -> list[Presence]:
        """Return the devices that are known, by type and place."""
        collector = await self._settled()
        found = await collector.list_devices(device_type=device_type, location=location)
        return [each for each in found if each.get("device_id") != self._device_id]

    async def get_device(self, device_id: str) -> Presence | None:
        """Return one device; while the first answers come in, wait for it."""
        collector = await self._asked()
        loop = asyncio.get_running_loop()
        while True:
            found: Presence | None = await collector.get_device(device_id)
            if found is not None or self._shared is None or loop.time() >= self._shared.settled_at:
                return found
            await asyncio.sleep(POLL_S)

    async def wait_for_device_type(self, device_type: str, timeout: float = 10.0) -> Presence | None:  # noqa: ASYNC109
        """Return the first device of a type, or None after ``timeout`` seconds."""
        found = await self._within(timeout, lambda: self.list_devices(device_type=device_type))
        return found[0] if found else None

    async def wait_for_device_id(self, device_id: str, timeout: float = 10.0) -> Presence | None:  # noqa: ASYNC109
        """Return the device of this id, or None after ``timeout`` seconds."""
        found: Presence | None = await self._within(timeout, lambda: self.get_device(device_id))
        return found

    async def _within(self, seconds: float, ask: Callable[[], Any]) -> Any:
        loop = asyncio.get_running_loop()
        until = loop.time() + seconds
        while True:
            found = await ask()
            if found or loop.time() >= until:
                return found
            await asyncio.sleep(POLL_S)

    def _listen(self, add: Callable[[Any], None], replayed: OnPeer | None = None) -> None:
        self._listens = True
        task = asyncio.create_task(self._begin_listening(add, replayed))
        self._replays.add(task)
        task.add_done_callback(self._replays.discard)

    async def _begin_listening(self, add: Callable[[Any], None], replayed: OnPeer | None) -> None:
        collector = await self._asked()
        known = await collector.list_devices()
        add(collector)
        if replayed is not None:
            report = self._others(replayed)
            for each in known:
                result = report(str(each.get("device_id", "")))
                if asyncio.iscoroutine(result):
                    await result

    def _others(self, callback: OnPeer) -> OnPeer:
        def report(device_id: str) -> Any:
            # The collector has no way to take a listener away again.
            return callback(device_id) if device_id != self._device_id and self._collector is not None else None

        return report

    async def _settled(self) -> Any:
        collector = await self._asked()
        if self._shared is not None:
            await asyncio.sleep(max(self._shared.settled_at - asyncio.get_running_loop().time(), 0.0))
        return collector

    async def _asked(self) -> Any:
        loop = asyncio.get_running_loop()
        self._asked_at = loop.time()
        async with self._entering:
            if self._collector is None:
                shared = _SHARED.setdefault((loop, self._link), _SharedCollector(self._link))
                self._collector, self._shared = await shared.enter(), shared
                self._letting_go = asyncio.create_task(self._let_go())
        return self._collector

    async def _let_go(self) -> None:
        loop = asyncio.get_running_loop()
        # Each question moves the end.
        while (left := KEEP_S if self._listens else self._asked_at + KEEP_S - loop.time()) > 0:  # noqa: ASYNC110
            await asyncio.sleep(left)
        await self._leave()

    async def _leave(self) -> None:
        async with self._entering:
            shared, self._shared, self._collector = self._shared, None, None
        if shared is not None:
            await shared.leave()
