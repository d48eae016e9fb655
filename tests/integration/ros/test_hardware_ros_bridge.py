"""Arms and simulations on a ROS 2 graph through rclpy's shape, with a bare DDS peer as the graph's other side."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures import rclpy_stand_in
from fixtures.devices import RecordingDevice
from fixtures.ros_bases import Lock
from fixtures.taking_arm import TakingArm
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.hardware_ros_bridge import HardwareRosBridge
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import RosError
from strands_robots.ros_telemetry import INSECURE, MAX_QOS_HISTORY_DEPTH
from strands_robots.simulation import Simulation
from strands_robots.simulation.ros_bridge import SimRosBridge
from strands_robots.utils import ValidationError

DOMAIN = 99
JOINTS = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"
SECURITY = ("ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY", "ROS_SECURITY_KEYSTORE")


@pytest.fixture
def sourced() -> Iterator[None]:
    """A ROS 2 that is sourced, as far as our code can tell."""
    with rclpy_stand_in.installed():
        yield


@pytest.fixture
def peer() -> Iterator[DdsLink]:
    link = DdsLink(DOMAIN, match_s=20.0)
    yield link
    link.close()


def test_a_joint_command_of_a_dds_peer_drives_the_arm_whole_or_not_at_all(
    sourced: None, peer: DdsLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INSECURE, "1")
    arm = TakingArm()
    bridge = HardwareRosBridge(arm, domain_id=DOMAIN, joint_limits={"a.pos": (-1.0, 1.0)}, spin_period=0.005)
    try:
        for bad in (
            {"name": ["b.pos", "a.pos"], "position": [0.1, 1.5]},
            {"name": ["a.pos", "b.pos"], "position": [0.1]},
            {"name": ["a.pos"], "position": [float("nan")]},
        ):
            peer.publish("/my_arm/joint_command", JOINTS, bad)
        last = {"name": ["a.pos", "b.pos"], "position": [0.5, 7.0]}

        def taken() -> bool:
            peer.publish("/my_arm/joint_command", JOINTS, last)
            return bool(arm.taken)

        eventually(taken)
        assert {tuple(each.items()) for each in arm.taken} == {(("a.pos", 0.5), ("b.pos", 7.0))}
        arm.locked = True
        assert bridge.apply(last) is False
    finally:
        bridge.shutdown()
        bridge.shutdown()
    ours = ("strands_hardware", "rclpy-strands_hardware")
    eventually(lambda: not [t for t in threading.enumerate() if t.name.startswith(ours)])


def test_bridge_without_a_robot_publishes_joints_and_images_to_a_dds_peer(sourced: None, peer: DdsLink) -> None:
    bridge = HardwareRosBridge(domain_id=DOMAIN)
    received: dict[str, Any] = {}
    peer.watch("/my_arm/joint_states", JOINTS, lambda m: received.update(joints=m))
    peer.watch("/my_arm/front/image_raw", IMAGE, lambda m: received.update(image=m))
    picture = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)

    def published() -> bool:
        bridge.publish_joint_states("my arm", ["a.pos"], [0.25])
        bridge.publish_joint_states("my arm", ["a.pos", "b.pos"], [9.0])
        bridge.publish_image("my arm", "front", picture)
        bridge.publish_image("my arm", "front", picture[:, :, 0])
        return len(received) == 2

    try:
        eventually(published)
        joints, image = received["joints"], received["image"]
        assert (joints["name"], joints["position"], joints["header"]["stamp"]["sec"] > 0) == (["a.pos"], [0.25], True)
        assert (image["height"], image["width"], image["step"], image["encoding"]) == (2, 4, 12, "rgb8")
        assert (image["header"]["frame_id"], image["data"]) == ("front", picture.tobytes())
    finally:
        bridge.shutdown()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"enable_commands": "false"}, "enable_commands"),
        ({"domain_id": 233}, "domain_id"),
        ({"domain_id": True}, "domain_id"),
        ({"qos_depth": 0}, "qos_depth"),
        ({"qos_depth": MAX_QOS_HISTORY_DEPTH + 1}, "qos_depth"),
        ({"spin_period": 0}, "spin_period"),
        ({"spin_period": float("inf")}, "spin_period"),
        ({"node_name": "no node"}, "node_name"),
        ({"command_robot_name": 0}, "command_robot_name"),
        ({"joint_limits": {"a": (1.0, float("nan"))}}, "joint_limits"),
        ({"joint_limits": {"a": (2.0, 1.0)}}, "joint_limits"),
        ({"joint_limits": [1]}, "joint_limits"),
    ],
)
def test_invalid_bridge_argument_is_refused_before_ros_2_is_imported(
    options: dict[str, Any], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INSECURE, "1")
    before, threads = dict(os.environ), set(threading.enumerate())
    with pytest.raises(ValidationError, match=named):
        HardwareRosBridge(TakingArm(), **{"domain_id": DOMAIN, **options})
    assert dict(os.environ) == before
    assert set(threading.enumerate()) <= threads


def test_commands_on_an_unsecured_graph_need_the_opt_out_or_ros_security(
    sourced: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    secured = dict(zip(SECURITY, ("true", "Enforce", str(tmp_path)), strict=True))
    for weak in ({}, {"ROS_SECURITY_ENABLE": "True"}, {"ROS_SECURITY_STRATEGY": "enforce"}, {SECURITY[2]: "/nowhere"}):
        with monkeypatch.context() as patched:
            for name, value in {**secured, **weak}.items() if weak else []:
                patched.setenv(name, value)
            with pytest.raises(ValidationError, match=INSECURE):
                HardwareRosBridge(TakingArm(), domain_id=DOMAIN)
    HardwareRosBridge(TakingArm(), domain_id=DOMAIN, enable_commands=False).shutdown()
    for name, value in secured.items():
        monkeypatch.setenv(name, value)
    # The graph counts as secured; joining it is the middleware's, and the stand-in joins open ones only.
    with pytest.raises(RosError, match="open graphs only"):
        HardwareRosBridge(TakingArm(), domain_id=DOMAIN)


def test_bridge_without_a_ros_2_is_one_clear_error() -> None:
    for make in (HardwareRosBridge, SimRosBridge):
        with pytest.raises(RosError, match="source a ROS 2 installation"):
            make(domain_id=DOMAIN)


def test_simulation_publishes_joints_and_a_camera_to_a_dds_peer(sourced: None, peer: DdsLink) -> None:
    world = Simulation("bench")
    world.add_robot("arm", "so100")
    bridge = SimRosBridge(world, domain_id=DOMAIN)
    received: dict[str, Any] = {}
    peer.watch("/arm/joint_states", JOINTS, lambda m: received.update(joints=m))
    peer.watch("/bench/overview/image_raw", IMAGE, lambda m: received.update(image=m))
    try:
        bridge.start(20.0, ["overview"])
        with pytest.raises(ValidationError, match="called before"):
            bridge.start()
        eventually(lambda: len(received) == 2)
        observed = world.get_observation("arm")
        joints = dict(zip(received["joints"]["name"], received["joints"]["position"], strict=True))
        assert joints == pytest.approx({name: observed[name] for name in joints}, abs=0.05)
        assert len(joints) == 6
        assert (received["image"]["width"], received["image"]["height"]) == (320, 240)
    finally:
        bridge.shutdown()
        bridge.shutdown()
        world.cleanup()


def test_simulation_with_two_names_of_one_topic_is_refused_before_ros_2_is_imported() -> None:
    world = Simulation("bench")
    world.add_robot("arm-1", "so100")
    world.add_robot("arm_1", "so100", position=[1.0, 0.0, 0.0])
    try:
        with pytest.raises(ValidationError, match="robot 'arm_1' must have a topic of its own: /arm_1/joint_states"):
            SimRosBridge(world, domain_id=DOMAIN)
    finally:
        world.cleanup()


def test_hardware_robot_is_published_driven_and_locked_over_the_graph(
    sourced: None, peer: DdsLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INSECURE, "1")
    device = RecordingDevice()
    robot = HardwareRobot(device, "arm", control_hz=200)
    robot.connect()
    bridge = HardwareRosBridge(robot, domain_id=DOMAIN, spin_period=0.005)
    received: list[Any] = []
    peer.watch("/arm/joint_states", JOINTS, received.append)
    try:
        bridge.start(50.0)
        joints = eventually(lambda: received)[-1]
        command = {"name": joints["name"], "position": [25.0] * len(joints["name"])}

        def obeyed() -> bool:
            peer.publish("/arm/joint_command", JOINTS, command)
            return bool(received[-1]["position"] == command["position"])

        eventually(obeyed)
        robot.gate.attach(Lock())
        peer.publish("/arm/joint_command", JOINTS, {**command, "position": [50.0] * len(joints["name"])})
        assert bridge.apply({**command, "position": [50.0] * len(joints["name"])}) is False
        assert received[-1]["position"] == command["position"]
    finally:
        bridge.shutdown()
        robot.cleanup()
