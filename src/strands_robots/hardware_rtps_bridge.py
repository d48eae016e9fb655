"""A real robot's joints and cameras on a ROS 2 graph, and its joint commands from it, over bare DDS."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from strands_robots.ros.dds import DdsLink
from strands_robots.ros_telemetry import RosTelemetryBase, refuse_unsecured
from strands_robots.utils import ValidationError, mapping, missing_extra, shown, text

CREDENTIALS = ("identity_ca", "certificate", "private_key", "governance", "permissions")


class HardwareRtpsBridge(RosTelemetryBase):
    """Publishes joints and images, and forwards ``/<robot>/joint_command`` to ``robot.send_action``.

    Commands are taken as :class:`~strands_robots.ros_telemetry.RosTelemetryBase` says.

    Args:
        robot: the robot to drive; None for a bridge that only publishes.
        domain_id: DDS domain, 0 to 232.
        enable_commands: take commands, which needs a secured graph or the explicit opt-out.
        command_robot_name: whose command topic is taken; the robot's own name by default.
        poll_period: seconds between two looks for a command, above 0.
        joint_limits: ``{"<motor>.pos": (min, max)}`` in the robot's unit; what is not named is not limited here.
        dds_security_config: paths or URIs of ``identity_ca``, ``certificate``, ``private_key``, ``governance``,
            ``permissions`` and, optionally, ``permissions_ca``. The supported Cyclone DDS wheels have no DDS Security,
            so that a well-formed one is refused too: nothing is started without what it asks for.

    Raises:
        ValidationError: an argument outside its domain, or commands on a graph that nobody secured.
        MissingExtraError: the [ros2] extra is not installed.
    """

    def __init__(
        self,
        robot: Any = None,
        *,
        domain_id: int = 0,
        enable_commands: bool = True,
        command_robot_name: str | None = None,
        poll_period: float = 0.02,
        joint_limits: dict[str, tuple[float, float]] | None = None,
        dds_security_config: dict[str, str] | None = None,
    ) -> None:
        super().__init__(
            robot,
            domain_id=domain_id,
            enable_commands=enable_commands,
            command_robot_name=command_robot_name,
            period=poll_period,
            period_name="poll_period",
            joint_limits=joint_limits,
        )
        if find_spec("cyclonedds") is None:
            raise missing_extra("HardwareRtpsBridge", "ros2")
        _refuse_security(dds_security_config)
        if self._takes_commands:
            refuse_unsecured("bare DDS is not secured here.")
        self._begin(DdsLink(self.domain_id), "rtps-bridge")


def _refuse_security(config: object) -> None:
    if config is None:
        return
    checked = mapping("dds_security_config", config)
    missing = [key for key in CREDENTIALS if key not in checked]
    unknown = sorted(set(checked) - {*CREDENTIALS, "permissions_ca"})
    if missing or unknown:
        raise ValidationError(
            f"dds_security_config must have {', '.join(CREDENTIALS)} and may have permissions_ca, not {shown(checked)}."
        )
    for key, value in checked.items():
        text(f"dds_security_config[{key!r}]", value)
    raise ValidationError(
        "dds_security_config cannot be honoured: the wheels of cyclonedds 11 have no DDS Security. Use a ROS 2 whose "
        "middleware has it, behind a rosbridge server."
    )
