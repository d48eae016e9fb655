"""Put an arm on a ROS 2 graph and drive it from there, over bare DDS and by rclpy, without ROS and without an arm.

    .venv/bin/python -m examples.ros_arm

The arm is simulated; a real one is given to the bridges in its place. The controller is a plain DDS peer, as a ROS 2
node would be. This project's stand-in takes the place of rclpy, which comes with a ROS 2 installation.
"""

from __future__ import annotations

import os
from typing import Any

from fixtures import rclpy_stand_in
from fixtures.waiting import eventually

from strands_robots.hardware_ros_bridge import HardwareRosBridge
from strands_robots.hardware_rtps_bridge import HardwareRtpsBridge
from strands_robots.ros.dds import DdsLink
from strands_robots.ros_telemetry import JOINT_STATE, RosTelemetryBase
from strands_robots.simulation import Simulation
from strands_robots.simulation.ros_bridge import SimRosBridge

DOMAIN = 98
JOINT = "shoulder_pan"


def drive(world: Any, bridge: RosTelemetryBase, controller: DdsLink, to: float) -> None:
    """Command one joint over the graph, and publish where it went."""
    command = {"name": [JOINT], "position": [to]}

    def arrived() -> bool:
        controller.publish(bridge.command_topic, JOINT_STATE, command)
        return bool(abs(world.get_observation("arm")[JOINT] - to) < 0.05)

    eventually(arrived, within=20.0)
    states: list[Any] = []
    unwatch = controller.watch("/arm/joint_states", JOINT_STATE, states.append)

    def published() -> bool:
        # A bridge of a real robot does this by itself after bridge.start(20.0).
        joints = world.get_observation("arm")
        bridge.publish_joint_states("arm", list(joints), list(joints.values()))
        return bool(states)

    eventually(published)
    unwatch()
    place = dict(zip(states[-1]["name"], states[-1]["position"], strict=True))[JOINT]
    print(f"{type(bridge).__name__}: commanded {to:g} rad, {place:.2f} rad told on /arm/joint_states")


def main() -> None:
    world = Simulation("bench")
    world.add_robot("arm", "so100")
    controller = DdsLink(DOMAIN, match_s=5.0)
    limits = {JOINT: (-1.0, 1.0)}
    pictures: list[Any] = []
    try:
        over_dds = HardwareRtpsBridge(world, domain_id=DOMAIN, joint_limits=limits)
        drive(world, over_dds, controller, 0.5)
        over_dds.shutdown()
        over_rclpy = HardwareRosBridge(world, domain_id=DOMAIN, joint_limits=limits)
        drive(world, over_rclpy, controller, -0.5)
        over_rclpy.shutdown()
        publisher = SimRosBridge(world, domain_id=DOMAIN)
        controller.watch("/bench/overview/image_raw", "sensor_msgs/msg/Image", pictures.append)
        publisher.start(10.0, ["overview"])
        eventually(lambda: pictures, within=20.0)
        print(
            f"SimRosBridge: a picture of {pictures[0]['width']} x {pictures[0]['height']} on /bench/overview/image_raw"
        )
        publisher.shutdown()
    finally:
        controller.close()
        world.cleanup()


if __name__ == "__main__":
    # Loopback only, so that the open graph is this machine's own.
    os.environ.setdefault("STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE", "1")
    os.environ.setdefault("ROS_LOCALHOST_ONLY", "1")
    with rclpy_stand_in.installed():
        main()
