"""Car with Ackermann steering on a ROS graph, by the kinematic bicycle model."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Any

from strands_robots.drivers.ros.mobile_base import LINK_ERRORS, MobileBaseRobot
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.actions import Ros2Link
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosLink, graph_name, interface
from strands_robots.safety.gate import MotionRefused, MotionRequest, Permit
from strands_robots.utils import ValidationError, mapping, number, shown

SERVO = "deepracer_interfaces_pkg/msg/ServoCtrlMsg"
SERVICE_S = 5.0
"""Seconds within which each service of the handshake has to answer."""


class AckermannRosRobot(MobileBaseRobot):
    """A car whose servo message holds ``angle`` and ``throttle``, each from -1 to 1.

    At speed v and yaw rate w the front wheels stand at atan(wheelbase * w / v), the kinematic bicycle model, at most
    ``max_steering_rad``. The car cannot turn in place, so a yaw rate without a speed is refused. It has no odometry:
    a stop is known to be sent, not to be done.

    Args:
        node_name: name of the robot and of its tools.
        servo_topic: topic of the servo messages, of ``servo_type``.
        wheelbase_m: distance of the axles in metres, above 0.
        max_speed: m/s at full throttle, above 0; faster drives are clamped to it.
        max_steering_rad: steering angle at full deflection, above 0 and below pi/2.
        max_duration: longest drive in seconds. ``publish_rate``: Hz of a timed or repeated drive.
        init_services: the handshake, in order: ``{"service", "type", "fields"}``. It runs once, before the first drive.
        link: the link to the graph; a handshake needs one that carries services. By default rclpy, where a ROS 2 is
            sourced; bare DDS carries neither services nor servo messages, so without a ROS 2 use a
            ``RosbridgeLink``.

    The other arguments are those of :class:`~strands_robots.drivers.ros.mobile_base.MobileBaseRobot`.
    """

    def __init__(
        self,
        node_name: str,
        servo_topic: str,
        scan_topic: str | None = None,
        *,
        servo_type: str = SERVO,
        scan_type: str | None = None,
        wheelbase_m: float = 0.164,
        max_speed: float = 1.5,
        max_steering_rad: float = 0.5236,
        max_duration: float = 10.0,
        publish_rate: float = 20.0,
        init_services: list[dict[str, Any]] | None = None,
        link: RosLink | None = None,
        command_gate: CommandGate | None = None,
    ) -> None:
        self.wheelbase_m = number("wheelbase_m", wheelbase_m, above=0)
        self.max_speed = number("max_speed", max_speed, above=0)
        self.max_steering_rad = number("max_steering_rad", max_steering_rad, above=0, high=math.pi / 2 - 1e-6)
        self._services = _services(init_services or [])
        self._enabled = False
        self._enabling = threading.Lock()
        super().__init__(
            node_name,
            link or Ros2Link(),
            servo_topic,
            servo_type,
            scan_topic=scan_topic,
            scan_type=scan_type,
            publish_rate=publish_rate,
            max_linear=self.max_speed,
            max_duration=number("max_duration", max_duration, above=0),
            command_gate=command_gate,
        )
        self.safety_key = f"ackermann:{node_name}:{servo_topic}"

    @classmethod
    def from_deepracer(cls, node_name: str, **overrides: Any) -> AckermannRosRobot:
        """Construct an AWS DeepRacer with its stock software.

        The names are those of its web server's package; no car was available to check them.
        """
        wiring: dict[str, Any] = {
            "servo_topic": "/webserver_pkg/manual_drive",
            "scan_topic": "/rplidar_ros/scan",
            "init_services": [
                {
                    "service": "/ctrl_pkg/vehicle_state",
                    "type": "deepracer_interfaces_pkg/srv/ActiveStateSrv",
                    "fields": {"state": 1},
                },
                {
                    "service": "/ctrl_pkg/enable_state",
                    "type": "deepracer_interfaces_pkg/srv/EnableStateSrv",
                    "fields": {"is_active": True},
                },
            ],
        }
        return cls(node_name, **(wiring | overrides))

    @property
    def min_radius_m(self) -> float:
        """The tightest circle in metres, measured at the rear axle."""
        return self.wheelbase_m / math.tan(self.max_steering_rad)

    def motion_note(self) -> str:
        return (
            f"It cannot turn in place; its tightest turning radius is {self.min_radius_m:.2f} m, its speed at most "
            f"{self.max_speed:g} m/s."
        )

    def check_motion(self, linear: float, angular: float) -> None:
        """Refuse a yaw rate without a speed: its message would be that of a stop."""
        if angular != 0 and linear == 0:
            raise ValidationError(
                f"angular must be 0 at standstill, not {angular:g}: the car steers with its front wheels and cannot "
                "turn in place."
            )

    def command_message(self, linear: float, angular: float) -> dict[str, Any]:
        """Return ``angle`` and ``throttle``, from -1 to 1, for m/s and rad/s."""
        if linear == 0:
            return {"angle": 0.0, "throttle": 0.0}
        # atan2 with a positive second argument is atan of the quotient, without overflow at a crawl.
        steering = math.atan2(math.copysign(1.0, linear) * self.wheelbase_m * angular, abs(linear))
        return {
            "angle": max(-1.0, min(1.0, steering / self.max_steering_rad)),
            "throttle": max(-1.0, min(1.0, linear / self.max_speed)),
        }

    def enable(self, tool_context: Any = None, *, request: MotionRequest | None = None) -> Envelope:
        """Run the handshake up to its first failure, unless it succeeded before.

        An answer with ``success`` false or an ``error`` that is not zero is a call that failed.
        """
        try:
            permit = self.gate.permit("enable", request)
        except MotionRefused as locked:
            return locked.envelope
        return self._run_handshake(permit, tool_context) or success(f"{self.node_name} takes commands.", enabled=True)

    def handshake(self, tool_context: Any = None, *, request: MotionRequest | None = None) -> Envelope | None:
        answer = self.enable(tool_context, request=request)
        return answer if answer["status"] == "error" else None

    def _run_handshake(self, permit: Permit, tool_context: Any) -> Envelope | None:
        with self._enabling:
            if self._enabled:
                return None
            # Ask for all approvals before arming anything, because asking may leave this call and repeat it.
            for service, kind, _ in self._services:
                refusal = self.command_gate.refusal(service, kind, "enable", tool_context)
                if refusal is not None:
                    return refusal
            for service, kind, fields in self._services:
                permit.wait()
                if not permit.valid:
                    return error(f"The handshake was stopped before {service}.")
                try:
                    answer = self.link.call(service, kind, fields, SERVICE_S)
                except LINK_ERRORS as exc:
                    return error(f"The handshake failed at {service}: {exc}", service=service)
                if not answer.get("success", True) or answer.get("error"):
                    return error(f"The handshake failed at {service}, which answered {shown(answer)}.", service=service)
            self._enabled = True
            return None


def _services(stated: Sequence[Any]) -> list[tuple[str, str, dict[str, Any]]]:
    if not isinstance(stated, list | tuple):
        raise ValidationError(f"init_services must be a list of calls, not {shown(stated)}.")
    calls = []
    for index, each in enumerate(stated):
        where = f"init_services[{index}]"
        call = mapping(where, each)
        calls.append(
            (
                graph_name(f"{where}.service", call.get("service")),
                interface(f"{where}.type", call.get("type")),
                mapping(f"{where}.fields", call.get("fields", {})),
            )
        )
    return calls
