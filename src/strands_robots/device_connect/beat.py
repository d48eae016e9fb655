"""One beat a second for all devices of a loop and a link: which of them live.

It is a heartbeat of the first of them, on whose topic access rules let them publish, with the ids of all in
``devices``. A reader of heartbeats that does not know the field sees one more heartbeat.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from device_connect_edge.messaging.exceptions import MessagingError

from strands_robots.bounded_json import json_object
from strands_robots.device_connect.backends import LinkConfig

logger = logging.getLogger(__name__)

BEAT_S = 1.0
"""Seconds between two beats of a process."""

HEARTBEAT_S = 5.0
"""Seconds between two heartbeats of a single device, by the framework's default."""

MISSED_BEATS = 3
"""Beats of a device that are missing in a row when it counts as silent."""

MARK = b'"devices"'
"""Part of every beat; a heartbeat without it is that of one device."""


@dataclass(frozen=True, slots=True)
class Beating:
    """One device of a beat.

    Attributes:
        device_id: its id.
        messaging: its connected client.
        lives: returns False while its robot cannot be read; the beat leaves it out then.
        fields: returns what a heartbeat of this device carries.
    """

    device_id: str
    messaging: Any
    lives: Callable[[], bool]
    fields: Callable[[], Mapping[str, Any]]


class Beat:
    """The beat of one loop and one link."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = link
        self._devices: dict[str, Beating] = {}
        self._task: asyncio.Task[None] | None = None

    def join(self, device: Beating) -> None:
        """Name ``device`` from now on."""
        self._devices[device.device_id] = device
        if self._task is None:
            self._task = asyncio.create_task(self._run(), name="beat")

    def leave(self, device: Beating) -> None:
        """Name ``device`` no more; the last one ends the beat."""
        if self._devices.get(device.device_id) is device:
            del self._devices[device.device_id]
        if not self._devices and self._task is not None:
            self._task.cancel()
            self._task = None
            _BEATS.pop((asyncio.get_running_loop(), self._link), None)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            await self._send()
            due = max(due + BEAT_S, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _send(self) -> None:
        living = [each for each in self._devices.values() if each.lives()]
        if not living:
            return
        first = living[0]
        try:
            beat = {"device_id": first.device_id, "ts": time.time(), **first.fields()}
            beat["devices"] = [each.device_id for each in living]
            await first.messaging.publish(
                f"device-connect.{self._link.tenant}.{first.device_id}.heartbeat", json.dumps(beat).encode()
            )
        except (MessagingError, TypeError, ValueError) as exc:
            # Without a link there is nobody to tell; what a robot's state makes unsendable is told by its heartbeat.
            logger.debug("a beat was not sent: %s", exc)


_BEATS: dict[tuple[asyncio.AbstractEventLoop, LinkConfig], Beat] = {}


def beat_of(link: LinkConfig) -> Beat:
    """Return the running loop's beat on ``link``."""
    return _BEATS.setdefault((asyncio.get_running_loop(), link), Beat(link))


def named_in(data: bytes) -> Iterable[str]:
    """Return the devices in a beat; none for the heartbeat of a single one."""
    if MARK not in data:
        return ()
    devices = json_object(data).get("devices")
    return [each for each in devices if isinstance(each, str)] if isinstance(devices, list) else ()
