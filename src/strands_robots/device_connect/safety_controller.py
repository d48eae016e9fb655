"""A safety controller on Device Connect, alone or as a device of its own."""

from __future__ import annotations

import asyncio
from typing import Any

from device_connect_edge.drivers import DeviceDriver
from device_connect_edge.types import DeviceIdentity, DeviceStatus

from strands_robots.device_connect._compat import emit, rpc
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.enrollment import enrolled_robots
from strands_robots.device_connect.links import usual_link
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.controller import DEADLINE_S, SafetyController, StopReport
from strands_robots.utils import ValidationError, device_id, number, text


def safety_controller(controller_id: str, link: LinkConfig | None = None, **options: Any) -> SafetyController:
    """Return a :class:`SafetyController` on ``link``, else on the environment's.

    Further arguments are those of :class:`SafetyController`. The robots enrolled at this machine have to sign.
    """
    link = link or usual_link()
    options.setdefault("enrolled", lambda: enrolled_robots(link))
    return SafetyController(controller_id, lambda: stop_link(link), **options)


def envelope(report: StopReport) -> Envelope:
    """Return the report as an answer, an error unless every robot stopped."""
    fields: dict[str, Any] = {
        "estop_id": report.estop_id,
        "stopped": {name: round(each.latency_ms, 3) for name, each in report.stopped.items()},
        "not_stopped": {name: each.why for name, each in report.not_stopped.items()},
        "refused": {name: each.why for name, each in report.refused.items()},
        "silent": list(report.silent),
        "claimed": sorted(report.claimed),
        "alarms": dict(report.alarms),
        "link": report.link,
        "elapsed_ms": round(report.elapsed_ms, 3),
        "left_ms": round(report.left_ms, 3),
    }
    if report.ok:
        return success(f"Stopped {', '.join(sorted(report.stopped))}.", **fields)
    failures = [f"{name} did not stop" for name in report.not_stopped]
    failures += [f"{name} did not act on it" for name in report.refused]
    failures += [f"ALARM: {name}: {report.alarms[name]}" for name in report.alarmed]
    failures += [f"{name} is only claimed to have stopped: it did not sign" for name in report.claimed]
    failures += [f"{name} gave no answer" for name in report.silent]
    if not report.link:
        failures.append("the stop was not sent: the link is down")
    return error(f"{'; '.join(failures) or 'No robot answered the emergency stop'}.", **fields)


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
