"""Let a ROS 2 base navigate to a place, and stop it on its way, without ROS and without a robot.

    .venv/bin/python -m examples.ros_navigate

The navigation stack runs in a process of its own on loopback DDS. Where a ROS 2 is sourced the robot class speaks to it
by rclpy; here this project's stand-in for rclpy takes its place, so that the example runs anywhere. With a real
robot, source your ROS 2 and leave the two fixtures out.
"""

from __future__ import annotations

import os
import threading

from fixtures import rclpy_stand_in
from fixtures.base_process import nav2
from fixtures.waiting import eventually

from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.envelope import text_of

DOMAIN = 97


def main() -> None:
    robot = RosBridgedRobot("rover", "/cmd_vel", "/odom", nav_action="/navigate_to_pose", domain_id=DOMAIN)
    print(text_of(robot.navigate_to(0.3, 0.4, frame_id="map", timeout=30.0)))

    going = threading.Thread(target=lambda: print(text_of(robot.navigate_to(100.0, 0.0))))
    going.start()
    eventually(lambda: robot.get_task_status()["step_count"] > 10)
    print(text_of(robot.stop()))
    going.join()
    robot.disconnect()


if __name__ == "__main__":
    # The operator of this one approves what an operator of a real one would be asked for.
    os.environ.setdefault("STRANDS_ROS2_COMMAND_ALLOW", "cmd_vel,navigate_to_pose")
    os.environ.setdefault("ROS_LOCALHOST_ONLY", "1")
    with rclpy_stand_in.installed(), nav2(DOMAIN, "reach"):
        main()
