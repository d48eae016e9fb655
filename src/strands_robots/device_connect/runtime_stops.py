"""Emergency stops on the runtime's connection, taken once for the devices of a loop and a link.

Each stop ends in the safety plane, which halts every robot of the process, so that one subscription does for all of
them. The e-stop listener's own connection carries the same stops.
"""

from __future__ import annotations

import asyncio
from typing import Any, Protocol

from device_connect_edge.messaging.exceptions import MessagingError

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.discovery import parts
from strands_robots.safety.orders import params_of
from strands_robots.safety.stop_link import ESTOP
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)


class RegisteredDevice(Protocol):
    """A device that is registered with the safety plane."""

    runtime: Any

    async def on_estop(self, device_id: object, payload: object, raw: bytes | int | None = None) -> None:
        """Act on an emergency stop of ``device_id``."""


class RuntimeStops:
    """The subscription of one loop and one link, held by one of the devices."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = link
        self._devices: list[RegisteredDevice] = []
        self._holder: RegisteredDevice | None = None
        self._subscription: Any = None
        self._changing = asyncio.Lock()

    async def join(self, device: RegisteredDevice) -> None:
        """Have emergency stops received for ``device`` as well.

        Raises:
            MessagingError: the first device cannot subscribe.
        """
        async with self._changing:
            self._devices.append(device)
            await self._subscribe()

    async def leave(self, device: RegisteredDevice) -> None:
        """Receive none for ``device`` any more; another one takes the subscription over."""
        async with self._changing:
            if device not in self._devices:
                return
            self._devices.remove(device)
            if device is self._holder:
                subscription, self._holder, self._subscription = self._subscription, None, None
                try:
                    # The next one subscribes first: no stop falls between the two.
                    await self._subscribe()
                finally:
                    await subscription.unsubscribe()
            if not self._devices:
                _STOPS.pop((asyncio.get_running_loop(), self._link), None)

    async def _subscribe(self) -> None:
        while self._holder is None and self._devices:
            device = self._devices[0]
            subject = f"device-connect.{self._link.tenant}.*.event.{ESTOP}"
            try:
                self._subscription = await device.runtime.messaging.subscribe_to_stops(subject, self._on_stop)
            except MessagingError as exc:
                self._devices.remove(device)
                if not self._devices:
                    raise
                logger.warning("A device cannot receive the emergency stops of the others: %s", exc)
            else:
                self._holder = device

    async def _on_stop(self, data: bytes | int, subject: str, reply: str | None) -> None:
        params = params_of(data)
        # Not the holder: while the subscription passes from one device to the next there is none.
        for device in self._devices[:1]:
            await device.on_estop(parts(subject)[2], params, data)


_STOPS: dict[tuple[asyncio.AbstractEventLoop, LinkConfig], RuntimeStops] = {}


def stops_of(link: LinkConfig) -> RuntimeStops:
    """Return the running loop's emergency stops on ``link``."""
    return _STOPS.setdefault((asyncio.get_running_loop(), link), RuntimeStops(link))
