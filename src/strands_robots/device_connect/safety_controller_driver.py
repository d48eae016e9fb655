"""A safety controller as a device of its own."""

from __future__ import annotations

import asyncio
from typing import Any

from device_connect_edge.drivers import DeviceDriver
from device_connect_edge.types import DeviceIdentity, DeviceStatus

from strands_robots.device_connect._compat import emit, rpc
from strands_robots.device_connect.safety_controller import envelope
from strands_robots.envelope import error, success
from strands_robots.safety.controller import DEADLINE_S, SafetyController
from strands_robots.utils import ValidationError, device_id, number, text


class SafetyControllerDriver(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """The controller as a device; its stops leave on the controller's own link."""

    device_type = "safety_controller"

    def __init__(self, controller: SafetyController) -> None:
        super().__init__()
        self.controller = controller

    @property
    def identity(self) -> DeviceIdentity:
        """Identity of the controller, which has one model."""
        return DeviceIdentity(
            device_type=self.device_type,
            manufacturer="strands-robots",
            model="safety-controller",
            description="Stops robots",
        )

    @property
    def status(self) -> DeviceStatus:
        """Idle, always; a controller accepts every call."""
        return DeviceStatus(availability="idle", busy_score=0.0)

    @rpc(labels={"direction": "write", "safety": "critical"})
    async def stopAll(
        self, reason: str = "", expected: list[str] | None = None, deadline_s: float = DEADLINE_S
    ) -> dict[str, Any]:
        """Stop every robot of the tenant and answer for each by name.

        Args:
            reason: Why, told to the robots
            expected: Ids of the robots that must answer
            deadline_s: Seconds until a robot that gave no answer is reported as silent
        """
        try:
            names = [device_id("expected", each) for each in expected or []]
            why, within = (
                text("reason", reason, longest=200, empty=True),
                number("deadline_s", deadline_s, above=0, high=60),
            )
        except ValidationError as exc:
            return error(str(exc))
        return envelope(await asyncio.to_thread(self.controller.stop, names, why, deadline_s=within))

    @rpc(labels={"direction": "read"})
    async def getStatus(self) -> dict[str, Any]:
        """Say whether the controller's own link is up."""
        up = self.controller.link_up
        return success("The stop link is up." if up else "The stop link is down.", link_up=up)

    @emit(labels={"safety": "critical"})
    async def emergencyStop(self, reason: str = "") -> None:
        """Part of every controller's description; the stop itself leaves on the controller's own link.

        Args:
            reason: Why
        """
