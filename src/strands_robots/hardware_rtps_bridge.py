"""Bridge of a real robot to a ROS 2 graph over bare DDS."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from strands_robots.ros.dds import DdsCredentials, DdsLink, checked_credentials, governance_gap
from strands_robots.ros_telemetry import JOINT_SPEED, RosTelemetryBase, refuse_unsecured
from strands_robots.utils import missing_extra


class HardwareRtpsBridge(RosTelemetryBase):
    """Publisher of joints and images that takes ``/<robot>/joint_command``.

    Commands are taken as :class:`~strands_robots.ros_telemetry.RosTelemetryBase` describes.

    Args:
        robot: see :class:`~strands_robots.ros_telemetry.RosTelemetryBase`, as for ``enable_commands``,
            ``command_robot_name``, ``joint_limits`` and ``max_joint_speed``.
        domain_id: DDS domain, 0 to 232.
        poll_period: seconds between two looks for a command, above 0.
        dds_security_config: paths, ``file:`` or ``data:,`` URIs of ``identity_ca``, ``certificate``, ``private_key``,
            ``governance``, ``permissions`` and, where it is another, ``permissions_ca``. The participant presents them
            or does not come up. Commands need a governance that closes the command topic to strangers.

    Raises:
        ValidationError: an argument outside its domain, credentials that the installed library cannot honour, or
            commands on an unsecured graph.
        MissingExtraError: the [ros2] extra is not installed.
        RosError: the domain cannot be joined, or the permissions do not grant the command topic.
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
        max_joint_speed: float = JOINT_SPEED,
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
            max_joint_speed=max_joint_speed,
        )
        if find_spec("cyclonedds") is None:
            raise missing_extra("HardwareRtpsBridge", "ros2")
        credentials = checked_credentials(dds_security_config)
        link = DdsLink(self.domain_id, dds_security_config=dds_security_config)
        if self._takes_commands:
            refuse_unsecured(self._lacking(credentials))
        self._begin(link, "rtps-bridge", open_now=credentials is not None)

    def _lacking(self, credentials: DdsCredentials | None) -> str | None:
        if credentials is None:
            return "bare DDS is not secured without dds_security_config."
        found = governance_gap(credentials.document("governance"), self.domain_id, f"rt{self.command_topic}")
        return None if found is None else f"the governance does not close it: {found}."
