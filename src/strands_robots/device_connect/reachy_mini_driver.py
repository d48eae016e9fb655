"""Reachy Mini as a device: verbs, availability, events of its motions."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

from device_connect_edge.types import DeviceIdentity, DeviceStatus

from strands_robots.contract import RolloutEvent
from strands_robots.device_connect._compat import Labels, emit
from strands_robots.device_connect.base_driver import RobotDriver
from strands_robots.device_connect.telemetry import Activity
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.reachy.links import DEFAULT_PREFIX
from strands_robots.safety.authorization import Approval, Authorization
from strands_robots.serving.reachy_verbs import REACHY_VERBS
from strands_robots.serving.verbs import Verb
from strands_robots.utils import flag

logger = logging.getLogger(__name__)

UNAVAILABLE = "unavailable"

CONNECT_S = 1.0
"""Longest time in seconds that a program's ``connect`` waits for the link."""

FRESH_S = 1.0
"""Age in seconds below which joints count as fresh; a state is told when they cease to be."""


class ReachyMiniDriver(RobotDriver):
    """A Reachy Mini head: look, gesture, play recorded moves; end any motion with stopMotion.

    Args:
        host: bare hostname or IP literal of the daemon.
        prefix: of the Zenoh keys of a daemon before 1.5: identifiers joined by ``/``.
        api_port: TCP port of the daemon, 1 to 65535.
        transport: ``auto`` for what the daemon speaks, ``websocket`` or ``zenoh``.
        release_on_estop: switch the motors off at every emergency stop; the head drops. By default it stops and holds.
        robot: a ready :class:`ReachyDriver` in place of one for ``host``.

    Raises:
        ValidationError: (a ValueError) a host, prefix, port or transport outside its domain.
    """

    device_type = "reachy_mini"
    labels: ClassVar[Labels] = {"category": "robot"}
    verbs: ClassVar[Mapping[str, Verb]] = REACHY_VERBS

    def __init__(
        self,
        host: str = "reachy-mini.local",
        prefix: str = DEFAULT_PREFIX,
        api_port: int = 8000,
        *,
        transport: str = "auto",
        release_on_estop: bool = False,
        robot: ReachyDriver | None = None,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        self.reachy = robot or ReachyDriver(host, prefix, api_port, transport=transport)
        if flag("release_on_estop", release_on_estop):
            self.reachy.release_on_estop = True
        super().__init__(self.reachy, hardware=True, authorization=authorization, approval=approval)

    @property
    def identity(self) -> DeviceIdentity:
        """Identity of this device; ``model`` names the daemon's host."""
        connection = self.reachy.connection
        info = connection.info
        return DeviceIdentity(
            device_type=self.device_type,
            manufacturer="Pollen Robotics",
            model=f"Reachy Mini ({connection.host})",
            firmware_version=str(info.raw.get("version") or "") if info else "",
            description="Reachy Mini: an expressive head on a turning body",
        )

    @property
    def status(self) -> DeviceStatus:
        """Return ``busy``, ``idle``, or ``unavailable`` with the reason as error state."""
        away = self.reachy.connection.refusal()
        if away is None:
            return super().status
        return DeviceStatus(availability=UNAVAILABLE, busy_score=0.0, error_state=away)

    def status_of(self, activity: Activity) -> dict[str, Any]:
        """Return the fields of the status; a robot that is away is unavailable."""
        fields = super().status_of(activity)
        return {**fields, "availability": UNAVAILABLE} if activity.fault else fields

    async def connect(self) -> None:
        """Begin to connect; a daemon that is away is connected to when it appears.

        A program that calls this itself has the link afterwards, or a warning that there is none.
        """
        connection = self.reachy.connection
        connection.start()
        await super().connect()
        # A runtime announces the device at once, and its state says when the robot is there.
        if self.runtime is None and not await asyncio.to_thread(connection.wait, CONNECT_S):
            logger.warning(
                "No link to the Reachy Mini at %s:%d within %g s: its motions are refused until there is one.",
                connection.host,
                connection.port,
                CONNECT_S,
            )

    async def disconnect(self) -> None:
        """Halt what we started, let go of the robot, and refuse every motion from now on."""
        await super().disconnect()
        await asyncio.to_thread(self.reachy.disconnect)

    # Events.

    @emit()
    async def motionComplete(self, name: str, state: str, detail: str = "", duration: float = 0.0) -> None:
        """A motion ended.

        Args:
            name: Which motion, by its function or recorded move
            state: How it ended: completed, stopped, error or unknown
            detail: What ended it, or where it is instead of where it should be
            duration: Seconds from its start to its end
        """

    @emit()
    async def stateUpdate(
        self, moving: str = "", link: str = "", motor_mode: str = "", data_age_s: float = 0.0
    ) -> None:
        """Activity of the robot, told when it changes while it is available.

        Args:
            moving: Which motion runs, empty for none
            link: websocket or zenoh
            motor_mode: enabled, disabled or gravity_compensation
            data_age_s: Age of the newest joint sample in seconds
        """

    # What the base asks.

    def glance(self) -> Activity:
        """The driver's facts; away, they are its fault."""
        facts = self.reachy.facts()
        told = {key: facts[key] for key in ("moving", "link", "motor_mode")}
        return Activity(bool(facts["moving"]), {**told, "data_age_s": facts["data_age_s"] or 0.0}, facts["unavailable"])

    def same(self, one: Activity, other: Activity) -> bool:
        """Return True for two states that differ only in the age of fresh joints."""

        def told(activity: Activity) -> Activity:
            fresh = activity.facts.get("data_age_s", FRESH_S) < FRESH_S
            return replace(activity, facts={**activity.facts, "data_age_s": fresh})

        return told(one) == told(other)

    async def tell(self, activity: Activity) -> None:
        """Emit ``stateUpdate``."""
        await self.stateUpdate(**activity.facts)

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit ``motionComplete``."""
        if event.kind == "finished":
            await self.motionComplete(
                name=event.instruction, state=event.state, detail=event.error, duration=round(event.elapsed_s, 3)
            )
            self.reports.wake()
