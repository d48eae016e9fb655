"""Drive and stop three robots that speak ROS, without ROS and without a robot.

    .venv/bin/python -m examples.ros_bases

A rover behind a rosbridge server, a car behind the same server, and a base in a process of its own on loopback DDS.
The servers are this project's stand-ins; with a real robot, only the addresses differ.
"""

from __future__ import annotations

import os

from fixtures.base_process import base_process
from fixtures.rosbridge_server import RosbridgeServer

from strands_robots.drivers.ros.ackermann_robot import AckermannRosRobot
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.envelope import text_of
from strands_robots.ros.rosbridge import RosbridgeLink

DOMAIN = 92


def drive_and_stop(robot: MobileBaseRobot, linear: float, angular: float) -> None:
    """Drive for half a second, begin a long drive, and stop it."""
    print(f"{robot.node_name}: {text_of(robot.drive(linear, angular, duration=0.5))}")
    print(f"{robot.node_name}: {text_of(robot.start_drive(linear, angular, 10.0))}")
    print(f"{robot.node_name}: {text_of(robot.stop())}")
    robot.cleanup()


def over_rosbridge() -> None:
    """The rover and the car."""
    armed = {"/ctrl_pkg/vehicle_state": lambda _: {"error": 0}, "/ctrl_pkg/enable_state": lambda _: {"is_active": True}}
    server = RosbridgeServer(armed)
    server.on_publish = lambda topic, m: server.tell("/odom", {"twist": {"twist": m}}) if topic == "/cmd_vel" else None
    server.start()
    try:
        drive_and_stop(RosbridgeRobot("rover", "/cmd_vel", "/odom", host="127.0.0.1", port=server.port), 0.4, 0.2)
        link = RosbridgeLink("127.0.0.1", server.port)
        drive_and_stop(AckermannRosRobot.from_deepracer("racer", link=link, max_duration=20.0), 0.4, 0.5)
    finally:
        server.stop()


def over_dds() -> None:
    """The base on loopback DDS."""
    with base_process(DOMAIN):
        drive_and_stop(RtpsRobot("base", "/cmd_vel", odom_topic="/odom", domain_id=DOMAIN), 0.3, 0.0)


if __name__ == "__main__":
    # The operator of these three approves what an operator of real ones would be asked for.
    os.environ.setdefault("STRANDS_ROS2_COMMAND_ALLOW", "cmd_vel,manual_drive,vehicle_state,enable_state")
    os.environ.setdefault("ROS_LOCALHOST_ONLY", "1")
    over_rosbridge()
    over_dds()
