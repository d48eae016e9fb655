"""Emergency stops and lockouts of devices, in the safety plane or not."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from typing import Any, Protocol

from device_connect_edge.device import DeviceRuntime
from device_connect_edge.messaging.exceptions import MessagingError

from strands_robots.contract import Robot
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.discovery import parts
from strands_robots.device_connect.safety_registration import (
    LEAVE_TIMEOUT_S,
    REGISTER_S,
    REGISTRATIONS,
    SafetyRegistration,
    register_safety,
    register_served,
)
from strands_robots.envelope import Envelope, error
from strands_robots.safety.authorization import Authorization
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.lockout import LockoutLatch
from strands_robots.safety.orders import REASON_MAX, epoch_of, params_of
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_link import ESTOP
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.verbs import Arguments
from strands_robots.serving.workers import called
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown

logger = stop_logger(__name__)


class StoppedDevice(Protocol):
    """A driver as its emergency stops see it."""

    robot: Robot
    authorization: Authorization
    registration: SafetyRegistration | None
    runtime: Any

    @property
    def peer_id(self) -> str:
        """The device's id on the network."""


class DeviceStops:
    """Emergency stops of one device, and its resume.

    A device that is registered leaves both to the safety plane. One that no plane has locks itself, and the plane that
    it is registered with takes the lockout over.
    """

    def __init__(self, device: Any) -> None:
        self._device: StoppedDevice = device
        self._registered_here: SafetyRegistration | None = None
        self.unregistered: LockoutLatch | None = None
        """The lockout of a device that no plane has."""

    @property
    def latch(self) -> LockoutLatch | None:
        """The latch of a robot that no plane has; None where it holds none."""
        return self.unregistered if self.unregistered in self._device.robot.gate.latches else None

    @property
    def locked(self) -> bool | None:
        """True while an emergency stop locks the device; None where that is not known."""
        if self._device.registration is not None:
            return self._device.registration.entry.locked
        return None if self.latch is None else self.latch.state.locked

    def facts(self, nonce: str) -> dict[str, Any]:
        """Return the lockouts and the dead-man check-in, for the device's status."""
        registration, latch = self._device.registration, self.latch
        if registration is not None:
            return registration.facts(nonce)
        if latch is None:
            return {}
        return {"locked": latch.state.locked, "lockout": [each.fields() for each in latch.state.all]}

    def resume(self, arguments: Arguments, request: MotionRequest | None) -> Envelope:
        """Clear one epoch with a signed assertion, registered for it if need be."""
        device = self._device
        if device.registration is None and self.unregistered is not None:
            self._registered_here = register_safety(device.peer_id, device, None, named=False)
        registration = device.registration
        return error("resume rejected") if registration is None else registration.resume(arguments["assertion"])

    def receive(self, source: object, payload: object, raw: bytes | int | None = None) -> None:
        """Act on an emergency stop of the runtime, and return at once.

        ``raw`` is its message, or the number of bytes of one that is too long to be read.
        """
        if self._device.registration is not None:
            self._device.registration.runtime_estop(source, payload, raw)
            return
        halting = self.begin(source, payload)
        if halting is not None:
            halting.add_done_callback(lambda halted: self._log(source, halted.result()))

    def call_for(self, payload: Mapping[str, Any]) -> None:
        """Lock and halt before the network is told, which must be told whatever happens."""
        device = self._device
        try:
            if device.registration is not None:
                device.registration.raise_estop(payload)
            else:
                stop_executor().submit(device.robot, device.peer_id, "its own emergency stop")
        except Exception:
            logger.critical("%s: its own emergency stop failed.", device.peer_id, exc_info=True)

    def begin(self, source: object, payload: object) -> Future[StopVerdict] | None:
        """Lock and halt a device that no plane has; None for a stop that does not count."""
        device = self._device
        if source == device.peer_id:
            return None
        refusal = device.authorization.estop(source)
        if refusal is not None:
            logger.warning("%s: emergency stop ignored: %s.", device.peer_id, refusal)
            return None
        params = payload if isinstance(payload, Mapping) else {}
        why = params.get("reason", "")
        latch = self.latch
        if latch is None:
            latch = self.unregistered = LockoutLatch(device.peer_id)
            device.robot.gate.attach(latch)
        epoch = epoch_of(str(source), params, json.dumps(params, default=repr, skipkeys=True).encode())
        latch.engage(epoch, str(source), why[:REASON_MAX] if isinstance(why, str) else "")
        return stop_executor().submit(device.robot, device.peer_id, f"emergency stop of {source}: {shown(why)}")

    async def register(self) -> None:
        """Register with the safety plane, unless what serves this driver has done so."""
        await self.leave()
        device = self._device
        if device.registration is None and isinstance(device.runtime, DeviceRuntime):
            register = partial(register_served, device, device.runtime)
            self._registered_here = await called(REGISTRATIONS, register, REGISTER_S)

    async def leave(self) -> None:
        """Take back the registration that was made here."""
        registration, self._registered_here = self._registered_here, None
        if registration is not None:
            await called(REGISTRATIONS, registration.leave, LEAVE_TIMEOUT_S)

    def _log(self, source: object, verdict: StopVerdict) -> None:
        answer, peer = verdict.envelope(), self._device.peer_id
        if verdict.stopped:
            logger.warning("%s: halted by emergency stop of %s: %s", peer, source, answer["content"][0]["text"])
        else:
            logger.critical("%s: EMERGENCY STOP of %s DID NOT STOP IT: %s", peer, source, answer.get("reason"))


class RegisteredDevice(Protocol):
    """A device that is registered with the safety plane."""

    runtime: Any

    async def on_estop(self, device_id: object, payload: object, raw: bytes | int | None = None) -> None:
        """Act on an emergency stop of ``device_id``."""


class RuntimeStops:
    """Emergency stops on the runtime's connection, taken once for many devices.

    They have a loop and a link in common, and one of them holds the subscription. Each stop ends in the safety plane,
    which halts every robot of the process. The e-stop listener's own connection carries the same stops.
    """

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
