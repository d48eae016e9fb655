"""A safety controller as a device of its own."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from device_connect_edge.drivers import DeviceDriver
from device_connect_edge.types import DeviceIdentity, DeviceStatus

from strands_robots.device_connect._compat import emit, rpc
from strands_robots.device_connect.safety_controller import envelope, outcome_envelope
from strands_robots.envelope import Envelope, success
from strands_robots.safety.controller import DEADLINE_S, SafetyController
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.scope import Scope
from strands_robots.safety.stop_roster import RosterSearch, stop_and_search
from strands_robots.serving.stop_arguments import noted, stop_reason, stop_robot, stop_scope
from strands_robots.serving.verbs import unknown_arguments
from strands_robots.utils import ValidationError, number

EXPECTED_MAX = 1024
"""Names of robots that one stop expects to answer; it stops every robot all the same."""


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
        self,
        reason: str = "",
        expected: list[str] | None = None,
        deadline_s: float = DEADLINE_S,
        only: list[str] | None = None,
        cell: str = "",
    ) -> dict[str, Any]:
        """Stop every robot of the tenant, or some, and answer for each by name.

        Args:
            reason: Why, told to the robots
            expected: Ids of the robots that must answer
            deadline_s: Seconds until a robot that gave no answer is reported as silent
            only: Ids of the robots to stop; empty for all
            cell: Cell to stop, with every robot that is in none; empty for all
        """
        given = {"reason": reason, "expected": expected, "deadline_s": deadline_s, "only": only, "cell": cell}
        return await self._stop_all(given)

    async def invoke(self, function_name: str, **params: Any) -> Any:
        """Serve one call; a stop is refused for none of its arguments."""
        if function_name == "stopAll":
            params.pop("source_device", None)
            return await self._stop_all(params)
        return await super().invoke(function_name, **params)

    async def _stop_all(self, given: Mapping[str, Any]) -> dict[str, Any]:
        why, cut = stop_reason(given.get("reason"))
        asked, within, notes = given.get("expected"), DEADLINE_S, [cut]
        rows = asked[:EXPECTED_MAX] if isinstance(asked, list) else []
        names = [stop_robot("expected", each)[0] for each in rows]
        if asked and (not rows or len(rows) < len(asked) or not all(names)):
            notes.append("expected names what is no robot's id, or too many")
        try:
            within = number("deadline_s", given.get("deadline_s", DEADLINE_S), above=0, high=60)
        except ValidationError:
            notes.append(f"deadline_s is not above 0 and at most 60, so it is {DEADLINE_S:g}")
        scope, unread = stop_scope(given.get("only"), given.get("cell"))
        unknown = given.keys() - {"reason", "expected", "deadline_s", "only", "cell"}
        notes += [unread, unknown_arguments(len(unknown))]
        answer = await asyncio.to_thread(self._stopped, [*filter(None, names)], why, within, scope)
        return noted(answer, *notes)

    def _stopped(self, expected: list[str], reason: str, within: float, scope: Scope) -> Envelope:
        """Stop robots; where the controller's network is known its roster must answer."""
        controller = self.controller
        if controller.network is None:
            return envelope(controller.stop(expected, reason, deadline_s=within, scope=scope))
        search = RosterSearch(controller, new_epoch(), controller.network, scope=scope, named=expected)
        report = stop_and_search(controller, search, expected, reason, within)
        outcome = search.roster.outcome(report, replace(controller.sending, left=report.link))
        outcome.record(controller.controller_id)
        search.roster.remember(report)
        return outcome_envelope(outcome)

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
