"""Mobile base behind a rosbridge server, reached without ROS on this side."""

from __future__ import annotations

from typing import Any

from strands_robots.drivers.ros.mobile_base import PosedBaseRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosLink, graph_name
from strands_robots.ros.rosbridge import RosbridgeLink
from strands_robots.ros.rosbridge_session import RosbridgeAccess
from strands_robots.utils import number

ROS1_TWIST = "geometry_msgs/Twist"
CURIOSITY = "/curiosity_mars_rover"


class RosbridgeRobot(PosedBaseRobot):
    """A ROS 1 or ROS 2 base behind a rosbridge server, with limits by default.

    The first verb connects. Without ``access`` the connection is neither authenticated nor encrypted.

    Args:
        node_name: name of the robot and of its tools.
        cmd_vel_topic: the velocity topic, a ``geometry_msgs/Twist`` unless ``cmd_vel_type`` says otherwise.
        odom_topic: odometry or pose; with it a stop waits to see the base still. The server knows the
            types of this topic and of ``scan_topic`` where they are omitted.
        host: bare hostname or IP address of the server. ``port``: 1 to 65535.
        max_linear: clamp in m/s. ``max_angular``: clamp in rad/s. ``max_duration``: longest drive in seconds. All three
            are above 0 and required: this class has no unlimited drive.
        access: TLS, headers and a rosauth secret of the server.
        link: a link to use in place of the connection to ``host`` and ``port``.

    The other arguments are those of :class:`~strands_robots.drivers.ros.mobile_base.MobileBaseRobot`.
    """

    def __init__(
        self,
        node_name: str,
        cmd_vel_topic: str,
        odom_topic: str,
        scan_topic: str | None = None,
        *,
        host: str = "localhost",
        port: int = 9090,
        cmd_vel_type: str = ROS1_TWIST,
        odom_type: str | None = None,
        scan_type: str | None = None,
        max_linear: float = 2.0,
        max_angular: float = 1.0,
        max_duration: float = 30.0,
        publish_rate: float = 10.0,
        access: RosbridgeAccess | None = None,
        link: RosLink | None = None,
        command_gate: CommandGate | None = None,
    ) -> None:
        default = RosbridgeLink(host, port, access=access)
        super().__init__(
            node_name,
            link or default,
            cmd_vel_topic,
            cmd_vel_type,
            odom_topic=graph_name("odom_topic", odom_topic),
            odom_type=odom_type,
            scan_topic=scan_topic,
            scan_type=scan_type,
            publish_rate=publish_rate,
            max_linear=number("max_linear", max_linear, above=0),
            max_angular=number("max_angular", max_angular, above=0),
            max_duration=number("max_duration", max_duration, above=0),
            command_gate=command_gate,
        )
        self.safety_key = f"rosbridge:{default.url}{cmd_vel_topic}"

    @classmethod
    def from_curiosity(
        cls, node_name: str = "curiosity", host: str = "localhost", port: int = 9090, **overrides: Any
    ) -> RosbridgeRobot:
        """Construct the Curiosity rover of the Gazebo simulation for ROS 1 Noetic."""
        wiring: dict[str, Any] = {
            "cmd_vel_topic": f"{CURIOSITY}/ackermann_drive_controller/cmd_vel",
            "odom_topic": f"{CURIOSITY}/odom",
            "host": host,
            "port": port,
        }
        return cls(node_name, **(wiring | overrides))

    def motion_note(self) -> str:
        return f"At most {self.max_linear:g} m/s, {self.max_angular:g} rad/s and {self.max_duration:g} s."
