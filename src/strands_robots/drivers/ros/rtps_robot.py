"""ROS 2 mobile base over bare DDS, reached without ROS 2 on this side."""

from __future__ import annotations

from typing import Any

from strands_robots.drivers.ros.mobile_base import LINK_ERRORS, TWIST, PosedBaseRobot
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.gate import CommandGate


class RtpsRobot(PosedBaseRobot):
    """A base that subscribes to velocities in a DDS domain, without default limits.

    The first verb joins the domain. A drive without a subscription is an error, and so is a stop.

    Args:
        node_name: name of the robot and of its tools.
        cmd_vel_topic: the velocity topic, of ``cmd_vel_type`` (a Twist or a TwistStamped).
        odom_topic: a ``nav_msgs/Odometry``; with it a stop waits to see the base still.
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.
        dds_security_config: credentials for a secured graph, as those of
            :class:`~strands_robots.hardware_rtps_bridge.HardwareRtpsBridge`; without, the participant has none.

    The other arguments are those of :class:`~strands_robots.drivers.ros.mobile_base.MobileBaseRobot`.

    Raises:
        ValidationError: an argument outside its domain, or credentials that the installed library cannot honour.
    """

    link: DdsLink

    def __init__(
        self,
        node_name: str,
        cmd_vel_topic: str,
        *,
        cmd_vel_type: str = TWIST,
        publish_rate: float = 10.0,
        max_linear: float | None = None,
        max_angular: float | None = None,
        max_duration: float | None = None,
        odom_topic: str | None = None,
        odom_type: str | None = "nav_msgs/msg/Odometry",
        scan_topic: str | None = None,
        domain_id: int | None = None,
        command_gate: CommandGate | None = None,
        dds_security_config: dict[str, str] | None = None,
    ) -> None:
        link = DdsLink(domain_id, dds_security_config=dds_security_config)
        super().__init__(
            node_name,
            link,
            cmd_vel_topic,
            cmd_vel_type,
            odom_topic=odom_topic,
            odom_type=odom_type,
            scan_topic=scan_topic,
            scan_type="sensor_msgs/msg/LaserScan",
            publish_rate=publish_rate,
            max_linear=max_linear,
            max_angular=max_angular,
            max_duration=max_duration,
            command_gate=command_gate,
        )
        self._advertised = (cmd_vel_topic, cmd_vel_type)
        self.safety_key = f"dds:{link.domain_id}:{cmd_vel_topic}"

    @classmethod
    def from_rtps(cls, node_name: str, cmd_vel_topic: str, **kwargs: Any) -> RtpsRobot:
        """Construct the robot, by a name that matches the other classes."""
        return cls(node_name, cmd_vel_topic, **kwargs)

    def advertise(self) -> Envelope:
        """Join the domain as a publisher of the velocity topic; send nothing."""
        try:
            self.link.advertise(*self._advertised)
        except LINK_ERRORS as exc:
            return error(str(exc))
        topic, kind = self._advertised
        return success(f"Publishing {topic}.", topic=topic, type=kind, domain_id=self.link.domain_id)
