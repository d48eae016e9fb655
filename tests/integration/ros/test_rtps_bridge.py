from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from fixtures.taking_arm import TakingArm
from fixtures.waiting import eventually

from strands_robots.hardware_rtps_bridge import HardwareRtpsBridge
from strands_robots.ros.dds import DdsLink
from strands_robots.ros_telemetry import INSECURE
from strands_robots.utils import ValidationError

DOMAIN = 94
COMMAND = "/my_arm/joint_command"
JOINTS = "sensor_msgs/msg/JointState"
LIMITS = {"a.pos": (-1.0, 1.0)}


@pytest.fixture
def arm() -> TakingArm:
    return TakingArm()


@pytest.fixture
def bridge(arm: TakingArm, monkeypatch: pytest.MonkeyPatch) -> Iterator[HardwareRtpsBridge]:
    monkeypatch.setenv(INSECURE, "1")
    made = HardwareRtpsBridge(arm, domain_id=DOMAIN, joint_limits=LIMITS, poll_period=0.005)
    yield made
    made.shutdown()
    made.shutdown()
    ours = ("rtps-bridge", "dds-my_arm/joint_command")
    eventually(lambda: not [t for t in threading.enumerate() if t.name in ours])


@pytest.fixture
def controller() -> Iterator[DdsLink]:
    link = DdsLink(DOMAIN, match_s=20.0)
    yield link
    link.close()


def test_a_joint_command_drives_the_arm(arm: TakingArm, bridge: HardwareRtpsBridge, controller: DdsLink) -> None:
    controller.publish(COMMAND, JOINTS, {"name": ["a.pos", "b.pos"], "position": [0.5, 7.0]})
    eventually(lambda: arm.taken == [{"a.pos": 0.5, "b.pos": 7.0}])


@pytest.mark.parametrize(
    "bad",
    [
        {"name": ["b.pos", "a.pos"], "position": [0.1, 1.5]},
        {"name": ["a.pos", "b.pos"], "position": [0.1]},
        {"name": ["a.pos"], "position": [float("nan")]},
        {"name": ["a.pos", "a.pos"], "position": [0.1, 0.2]},
        {},
    ],
)
def test_command_with_one_invalid_joint_is_dropped_whole(
    arm: TakingArm, bridge: HardwareRtpsBridge, bad: dict[str, Any]
) -> None:
    assert bridge.apply(bad) is False
    assert arm.taken == []


def test_a_locked_arm_refuses_commands_from_the_graph(arm: TakingArm, bridge: HardwareRtpsBridge) -> None:
    arm.locked = True
    assert bridge.apply({"name": ["a.pos"], "position": [0.1]}) is False
    assert arm.taken == []


def test_joints_and_images_are_published(controller: DdsLink) -> None:
    bridge = HardwareRtpsBridge(domain_id=DOMAIN)
    received: dict[str, Any] = {}
    controller.watch("/my_arm/joint_states", JOINTS, lambda m: received.update(joints=m))
    controller.watch("/my_arm/front/image_raw", "sensor_msgs/msg/Image", lambda m: received.update(image=m))
    picture = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)

    def published() -> bool:
        bridge.publish_joint_states("my arm", ["a.pos"], [0.25])
        bridge.publish_joint_states("my arm", ["a.pos", "b.pos"], [9.0])
        bridge.publish_image("my arm", "front", picture)
        bridge.publish_image("my arm", "front", picture[:, :, 0])
        return len(received) == 2

    try:
        eventually(published)
        assert (received["joints"]["name"], received["joints"]["position"]) == (["a.pos"], [0.25])
        image = received["image"]
        assert (image["height"], image["width"], image["step"], image["encoding"]) == (2, 4, 12, "rgb8")
        assert image["data"] == picture.tobytes()
    finally:
        bridge.shutdown()


def test_camera_and_robot_of_a_digit_are_seen_by_a_peer(controller: DdsLink) -> None:
    bridge = HardwareRtpsBridge(domain_id=DOMAIN)
    picture = np.zeros((2, 4, 3), np.uint8)

    def listed() -> bool:
        bridge.publish_image("1st", "0", picture)
        return any(row["topic"] == "/robot_1st/camera_0/image_raw" for row in controller.topics())

    try:
        eventually(listed)
        with pytest.raises(ValidationError, match="camera 'camera-0' of '1st'"):
            bridge.publish_image("1st", "camera-0", picture)
    finally:
        bridge.shutdown()


def test_commands_on_an_unsecured_graph_need_the_opt_out(arm: TakingArm) -> None:
    with pytest.raises(ValidationError, match=INSECURE):
        HardwareRtpsBridge(arm, domain_id=DOMAIN)
    HardwareRtpsBridge(arm, domain_id=DOMAIN, enable_commands=False).shutdown()


CREDENTIALS = dict.fromkeys(("identity_ca", "certificate", "private_key", "governance", "permissions"), "/nowhere")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"enable_commands": "false"}, "enable_commands"),
        ({"domain_id": 233}, "domain_id"),
        ({"poll_period": 0}, "poll_period"),
        ({"poll_period": float("inf")}, "poll_period"),
        ({"command_robot_name": 0}, "command_robot_name"),
        ({"joint_limits": {"a": (1.0, float("nan"))}}, "joint_limits"),
        ({"joint_limits": {"a": (2.0, 1.0)}}, "joint_limits"),
        ({"joint_limits": [1]}, "joint_limits"),
        ({"dds_security_config": {"certificate": "x"}}, "dds_security_config must have"),
        ({"dds_security_config": CREDENTIALS}, "identity_ca'\\] must name a readable file"),
    ],
)
def test_invalid_bridge_argument_is_refused_before_anything_starts(
    arm: TakingArm, options: dict[str, Any], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INSECURE, "1")
    before = set(threading.enumerate())
    with pytest.raises(ValueError, match=named):
        HardwareRtpsBridge(arm, **{"domain_id": DOMAIN, **options})
    assert set(threading.enumerate()) <= before
