"""A turtle as a robot: its tools for an agent, a drive, a pose and a stop, and a base on a transport of the user's."""

import os

from strands_robots.drivers.ros import MobileBaseRobot, RosBridgedRobot

os.environ["STRANDS_ROS2_COMMAND_ALLOW"] = "/turtle1/cmd_vel,/base/cmd_vel"
turtle = RosBridgedRobot.from_ros(
    node_name="turtlesim",
    cmd_vel_topic="/turtle1/cmd_vel",
    odom_topic="/turtle1/pose",
    odom_type="turtlesim/msg/Pose",
    max_linear=2.0,
)
print("tools:", sorted(tool.tool_name for tool in turtle.tools))
for name, answer in (("drive", turtle.drive(linear=1.0)), ("pose", turtle.get_pose()), ("stop", turtle.stop())):
    print(name, answer["status"], answer["content"][0]["text"].splitlines()[0])


class Wire:
    """A transport that keeps what is published."""

    twist_type = "geometry_msgs/msg/Twist"

    def __init__(self):
        self.sent = []

    def publish(self, *, topic, type, fields, count, rate, tool_context=None):  # noqa: A002 - the name of 0.5
        self.sent.append(fields)
        return {"status": "success", "content": [{"text": f"published {count}"}]}

    def echo(self, *, topic, type=None, timeout=5.0, count=1):  # noqa: A002 - likewise
        return {"status": "success", "content": [{"text": "{}"}]}


base = MobileBaseRobot("base", "/base/cmd_vel", Wire(), max_linear=0.5)
print("drive:", base.drive(linear=0.2, duration=0.2)["status"])
