"""Emergency stops and lockouts of devices, in the safety plane or not."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Mapping
from concurrent.futures import Future
from functools import cached_property, partial
from typing import Any, Protocol

from device_connect_edge.device import DeviceRuntime
from device_connect_edge.drivers import DeviceDriver
from device_connect_edge.messaging.exceptions import MessagingError

from strands_robots.contract import Haltable, Robot, body_of
from strands_robots.device_connect._compat import link_of, stated_id
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.config import network_of
from strands_robots.device_connect.discovery import parts
from strands_robots.device_connect.stop_link import NoStopLink, stop_link
from strands_robots.envelope import Envelope, error
from strands_robots.safety.authorization import Authorization
from strands_robots.safety.estop_listener import ListenerRegistration, estop_listener
from strands_robots.safety.gate import MotionGate, MotionRequest
from strands_robots.safety.identity import DEFAULT_TENANT, SigningIdentity, local_name, robot_identity
from strands_robots.safety.lockout import LockoutLatch, is_epoch
from strands_robots.safety.orders import REASON_MAX, StopOrder, epoch_of, params_of
from strands_robots.safety.persistence import hardware_key, simulation_key
from strands_robots.safety.plane import Registered, plane
from strands_robots.safety.scope import own_cell
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_link import ESTOP, StopEvent
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.verbs import Arguments
from strands_robots.serving.workers import Share, called
from strands_robots.stop_log import stop_logger
from strands_robots.utils import RESERVED_DEVICE_IDS, shown, unreserved

logger = stop_logger(__name__)

REGISTRATIONS = Share(running=1000)
"""The threads on which devices are registered and leave: a store or a link that hangs delays no other device."""

REGISTER_S = 30.0
LEAVE_TIMEOUT_S = 15.0
"""Seconds that a device's end waits for the link of its e-stop listener to close."""


def register_safety(
    device_id: str,
    driver: DeviceDriver,
    link: LinkConfig | None,
    *,
    named: bool,
    tenant: str = DEFAULT_TENANT,
    cell: str = "",
) -> SafetyRegistration | None:
    """Register a driver's robot with the safety plane; None without a robot.

    Args:
        link: the device's; None where it is none that a connection of the listener's own can take.
        tenant: the device's, where there is no ``link``.
        named: the operator gave ``device_id``; a simulation's lockout is kept only then.
        cell: the cell that it is in; empty for none.
    """
    robot = getattr(driver, "robot", driver)
    gate = getattr(robot, "gate", None)
    if not isinstance(robot, Haltable) or not isinstance(gate, MotionGate):
        logger.warning("%s has no robot that the safety plane could halt; it hears no emergency stop.", device_id)
        return None
    key = _key(device_id, driver, robot, named=named)
    registration = SafetyRegistration(device_id, robot, link, key, link.tenant if link else tenant, cell=cell)
    if hasattr(driver, "registration"):
        driver.registration = registration
        registration.driver = driver
    return registration


def register_served(driver: DeviceDriver, runtime: Any) -> SafetyRegistration | None:
    """Register a driver that a runtime serves without :mod:`.bringup`; open its link.

    Raises:
        ValidationError: its id is reserved or taken in this process, or only signed stops count and no key is known.
        DuplicateDeviceError: another process of this machine serves it on the mesh.
    """
    link = link_of(runtime)
    device_id = unreserved("device_id", runtime.device_id, RESERVED_DEVICE_IDS)
    registration = register_safety(
        device_id, driver, link, named=stated_id(runtime), tenant=runtime.tenant, cell=cell_of(driver)
    )
    if registration is not None:
        try:
            registration.open()
        except BaseException:
            registration.leave()
            raise
    if link is None:
        logger.warning(
            "%s has no e-stop connection of its own: its runtime's backend is not one of ours. It is stopped and "
            "locked by the runtime's events, and answers no controller.",
            runtime.device_id,
        )
    return registration


def cell_of(driver: DeviceDriver, cell: str | None = None) -> str:
    """Return the cell as given, as driver or robot state it, or of ``STRANDS_CELL``.

    Raises:
        ValidationError: it is no identifier.
    """
    stated = (getattr(each, "cell", None) for each in (driver, body_of(getattr(driver, "robot", None))))
    return own_cell(next((each for each in (cell, *stated) if isinstance(each, str)), None))


def _key(device_id: str, driver: DeviceDriver, robot: Any, *, named: bool) -> str | None:
    stated = getattr(robot, "safety_key", None)
    if isinstance(stated, str) and stated:
        return stated
    if getattr(driver, "hardware", True):
        return hardware_key(str(getattr(robot, "tool_name_str", "robot")), device_id if named else "unnamed")
    return simulation_key(device_id) if named else None


class SafetyRegistration:
    """One robot in the safety plane and on the e-stop listener."""

    def __init__(
        self,
        device_id: str,
        robot: Any,
        link: LinkConfig | None,
        key: str | None,
        tenant: str = DEFAULT_TENANT,
        *,
        cell: str = "",
    ) -> None:
        self.device_id = device_id
        self.cell = cell
        # Two tenants may each have a device of this id in one process.
        name = local_name(tenant, device_id)
        self._name = name
        self.driver: Any = None
        self._network = None if link is None else network_of(link)
        self.was_here_s = None if self._network is None else sightings().was_here(self._network, device_id)
        """Seconds since this robot was last served from this machine; None where over ten minutes, or never."""
        self.entry: Registered = plane().register(name, robot, key=key, wire_id=device_id, cell=cell)
        self._held: Registered | None = self.entry
        try:
            self._listener: ListenerRegistration = estop_listener().register(
                name,
                ("device-connect", link),
                lambda: NoStopLink() if link is None else stop_link(link),
                lambda: self.identity,
                opened=False,
                network=self._network,
                was_here=self.was_here_s is not None,
            )
        except BaseException:
            self.entry.close()
            raise
        if not (link and link.loopback_only) and not estop_listener().signed:
            logger.warning(
                "%s: the source of an emergency stop is what it says it is. DEVICE_CONNECT_ESTOP_PUBLIC_KEYS is not "
                "set, so only a broker's access rules can vouch for it.",
                device_id,
            )

    @cached_property
    def identity(self) -> SigningIdentity | None:
        """The robot's key, read or made at the first use."""
        return robot_identity(self._name)

    def open(self) -> None:
        """Open the e-stop link, unless it is open; return before it is up.

        Until then the runtime's handler and every RPC ``stop`` stop the robot.

        Raises:
            DuplicateDeviceError: another process of this machine began to serve the robot on the mesh just before.
        """
        # No answer that this link sends waits for the key.
        identity = self.identity
        self._listener.open()
        if self._network is not None:
            public = None if identity is None else identity.public
            sightings().serve(
                self._network, self.device_id, cell=self.cell, signed_only=self.signed_only, public=public
            )

    @property
    def signed_only(self) -> bool:
        """True where only signed stops count."""
        return estop_listener().signed

    @property
    def up(self) -> bool:
        """True while the e-stop link of this device is connected."""
        return self._listener.link.up

    def runtime_estop(self, source: object, params: object, raw: bytes | int | None = None) -> None:
        """Act on an emergency stop of the runtime's handler; return at once."""
        if isinstance(source, str):
            network = "" if self._network is None else self._network.text
            stop = StopEvent(ESTOP, source, raw, time.monotonic(), network)
            estop_listener().accept(stop, "runtime", params if isinstance(params, Mapping) else {})

    def raise_estop(self, params: Mapping[str, Any]) -> None:
        """Lock and halt on this device's own emergency stop; return at once.

        Its event, which other devices and this one's listener get, is the same stop.
        """
        reason = str(params.get("reason") or "")[:REASON_MAX]
        epoch = epoch_of(self.device_id, params, json.dumps(params, default=repr).encode())
        estop_listener().stop_here(StopOrder(epoch, self.device_id, reason))

    def resume(self, assertion: object) -> Envelope:
        """Check a signed resume, which authorizes itself; sign the answer."""
        answer = self.entry.resume(assertion, "device-connect")
        nonce = assertion.get("nonce") if isinstance(assertion, Mapping) else None
        fields = {"status": answer["status"], "nonce": nonce if is_epoch(nonce) else "", **self._lock_fields()}
        return {**answer, "statement": signed(self.identity, Purpose.RESUME_ANSWER, self.device_id, fields)}

    def facts(self, nonce: str = "") -> dict[str, Any]:
        """Return the lockouts and the check-in of the robot, for ``getStatus``.

        Args:
            nonce: of the question; the signed part repeats it. Without one nothing is signed: a signature that fits
                every question proves nothing, and it is half of the answer's time.
        """
        lockouts = self.entry.latch.state.all
        check_in = plane().checkin.fields(time.monotonic())
        facts = {
            "locked": bool(lockouts),
            "lockout": [each.fields() for each in lockouts],
            "check_in": check_in,
            "stop_lane": self.up,
            "cell": self.cell,
        }
        if not nonce:
            return facts
        fields = {**self._lock_fields(), "check_in": check_in, "cell": self.cell, "nonce": nonce}
        return {**facts, "statement": signed(self.identity, Purpose.LOCKOUT_STATE, self.device_id, fields)}

    def _lock_fields(self) -> dict[str, Any]:
        epochs = self.entry.epochs
        return {"device_id": self.device_id, "locked": bool(epochs), "epochs": list(epochs)}

    def leave(self) -> None:
        """Leave listener and plane; block while a link closes. Safe to call twice."""
        self._listener.close()
        if self._network is not None:
            sightings().leave(self._network, self.device_id)
        if getattr(self.driver, "registration", None) is self:
            # Whatever serves the driver next registers it anew.
            self.driver.registration = None
        entry, self._held = self._held, None
        if entry is not None:
            entry.close()


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
