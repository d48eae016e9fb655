"""Registration of a device with the safety plane."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from device_connect_edge.drivers import DeviceDriver

from strands_robots.contract import Haltable, body_of
from strands_robots.device_connect._compat import link_of, stated_id
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.config import network_of
from strands_robots.device_connect.stop_link import NoStopLink, stop_link
from strands_robots.envelope import Envelope
from strands_robots.safety.estop_listener import ListenerRegistration, estop_listener
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.identity import DEFAULT_TENANT, SigningIdentity, local_name, robot_identity
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.orders import REASON_MAX, StopOrder, epoch_of
from strands_robots.safety.persistence import hardware_key, simulation_key
from strands_robots.safety.plane import Registered, plane
from strands_robots.safety.scope import own_cell
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose, signed
from strands_robots.safety.stop_link import ESTOP, StopEvent
from strands_robots.serving.workers import Share
from strands_robots.stop_log import stop_logger
from strands_robots.utils import RESERVED_DEVICE_IDS, unreserved

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
