from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from cyclonedds import domain as dds_domain
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from fixtures.base_process import BaseProcess, base_process
from fixtures.ros_bases import OPEN
from fixtures.waiting import eventually
from tests.integration.ros.conftest import obeyed, x_of

from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.dds_types import KINDS
from strands_robots.ros.link import RosError, bare_kind, filled, plain
from strands_robots.utils import ValidationError

DOMAIN = 91
ROOT = Path(__file__).resolve().parents[3]
TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture
def base() -> Iterator[BaseProcess]:
    with base_process(DOMAIN) as process:
        yield process


@pytest.fixture
def rover() -> Iterator[RtpsRobot]:
    robot = RtpsRobot("rover", "/cmd_vel", odom_topic="/odom", domain_id=DOMAIN, publish_rate=20, command_gate=OPEN)
    yield robot
    robot.disconnect()


@pytest.mark.usefixtures("patient")
def test_a_base_in_another_process_is_driven_and_stopped(base: None, rover: RtpsRobot) -> None:
    obeyed(rover)
    began, called = x_of(rover), time.monotonic()
    answer = rover.drive(0.3, 0.0, duration=1.0)
    took_s = time.monotonic() - called
    assert (answer["status"], answer["messages"], answer["trailing_zero"]) == ("success", 20, True)
    assert rover.stop()["stopped"] is True
    # 0.3 m on a machine that keeps the time; a burst that is held up holds its velocity for up to as long.
    assert 0.24 <= x_of(rover) - began <= 0.3 * max(1.0, took_s) + 0.06


@pytest.mark.usefixtures("patient")
def test_a_stop_ends_a_drive_of_a_base_in_another_process(base: None, rover: RtpsRobot) -> None:
    assert rover.advertise()["status"] == "success"
    obeyed(rover)
    began = x_of(rover)
    assert rover.start_drive(1.0, 0.0, 30.0)["status"] == "success"
    eventually(lambda: x_of(rover) > began + 0.1)
    verdict = rover.halt("test")
    assert (verdict.stopped, verdict.halted) == (True, ("drive",))
    stood = x_of(rover)
    assert rover.get_task_status()["task_status"] == "stopped"
    assert x_of(rover) == stood


@pytest.mark.usefixtures("patient")
def test_drive_of_a_base_that_died_is_an_error_and_did_not_stop(base: BaseProcess, rover: RtpsRobot) -> None:
    obeyed(rover)
    began = x_of(rover)
    assert rover.start_drive(0.5, 0.0, 30.0)["status"] == "success"
    eventually(lambda: x_of(rover) > began + 0.05)
    base.end()
    eventually(lambda: rover.get_task_status()["task_status"] == "error")
    verdict = rover.halt()
    assert verdict.stopped is False
    assert "No subscription to /cmd_vel" in verdict.not_stopped["velocity"]


def test_omitted_type_is_looked_up_on_the_graph(base: None) -> None:
    link = DdsLink(DOMAIN, match_s=20.0)
    ends = {("/cmd_vel", TWIST, "subscription"), ("/odom", "nav_msgs/msg/Odometry", "publisher")}
    try:
        assert "twist" in link.read("/odom", None, 20.0)
        eventually(lambda: ends <= {(each["topic"], each["type"], each["role"]) for each in link.endpoints()})
        with pytest.raises(RosError, match="its type is not known"):
            DdsLink(DOMAIN, match_s=0.1).read("/nothing", None, 0.1)
    finally:
        link.close()


def test_drive_and_stop_without_a_subscription_are_errors() -> None:
    robot = RtpsRobot.from_rtps("alone", "/alone/cmd_vel", domain_id=DOMAIN, command_gate=OPEN)
    try:
        assert "No subscription to /alone/cmd_vel" in robot.drive(0.1)["reason"]
        assert robot.halt().stopped is False
    finally:
        robot.disconnect()


def test_a_message_goes_from_one_link_to_another_and_a_closed_link_opens_again() -> None:
    sender, receiver = DdsLink(DOMAIN), DdsLink(DOMAIN)
    received: list[Mapping[str, Any]] = []
    try:
        unwatch = receiver.watch("/picture", "sensor_msgs/Image", received.append)
        sender.publish("/picture", "sensor_msgs/msg/Image", {"height": 1, "width": 2, "data": b"\x01\x02"})
        eventually(lambda: received and received[0]["data"] == b"\x01\x02")
        sender.close()
        sender.publish("/picture", "sensor_msgs/msg/Image", {"width": 3})
        eventually(lambda: received[-1]["width"] == 3)
        unwatch()
    finally:
        sender.close()
        receiver.close()


def test_a_read_leaves_no_thread_behind(base: None) -> None:
    link = DdsLink(DOMAIN)
    try:
        for _ in range(3):
            link.read("/odom", "nav_msgs/Odometry", 20.0)
            eventually(lambda: not [t for t in threading.enumerate() if t.name.startswith("dds-")])
    finally:
        link.close()


def test_unreadable_message_does_not_cost_the_others(caplog: pytest.LogCaptureFixture) -> None:
    link = DdsLink(DOMAIN)
    received: list[Mapping[str, Any]] = []
    garbler = subprocess.Popen(
        [sys.executable, "-m", "fixtures.dds_garbler", str(DOMAIN)], stdin=subprocess.PIPE, cwd=ROOT
    )
    try:
        link.watch("/garbled", "std_msgs/msg/String", received.append)
        eventually(lambda: len(received) >= 5)
        assert "cannot be read" in caplog.text
        assert {each["data"] for each in received} == {"good"}
    finally:
        garbler.communicate(timeout=40)
        link.close()


def test_service_and_unknown_type_over_bare_dds_are_errors() -> None:
    link = DdsLink(DOMAIN)
    with pytest.raises(RosError, match="is a service"):
        link.call("/add", "pkg/srv/Add", {}, 1.0)
    with pytest.raises(RosError, match="nav_msgs/msg/Path is not among the types"):
        link.publish("/path", "nav_msgs/msg/Path", {})


@pytest.mark.parametrize("domain", [-1, 233, True, "0", 1.0])
def test_invalid_domain_is_refused_at_construction(domain: Any) -> None:
    with pytest.raises(ValidationError, match="domain_id must be an integer from 0 to 232"):
        RtpsRobot("rover", "/cmd_vel", domain_id=domain)


@pytest.mark.parametrize(
    ("topic", "kind", "message"),
    [
        ("/robot_description", "std_msgs/msg/String", {"data": "<robot/>"}),
        ("/map", "nav_msgs/msg/OccupancyGrid", {"info": {"width": 2, "height": 1}, "data": [-1, 100]}),
        ("/robot/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [{"child_frame_id": "camera"}]}),
    ],
)
def test_latched_topic_is_read_after_its_only_message(topic: str, kind: str, message: dict[str, Any]) -> None:
    participant = dds_domain.DomainParticipant(DOMAIN)
    struct = KINDS[bare_kind(kind)]
    latching = Qos(Policy.Durability.TransientLocal, Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(1))
    writer = DataWriter(participant, Topic(participant, f"rt{topic}", struct), qos=latching)
    written = filled(struct(), message, lambda inner: KINDS[inner]())
    writer.write(written)
    link = DdsLink(DOMAIN, match_s=20.0)
    try:
        read = link.read(topic, kind, 20.0)
        assert message.keys() <= read.keys()
        assert read == plain(written)
    finally:
        link.close()


def test_pose_of_the_turtle_is_carried() -> None:
    ours, theirs = DdsLink(DOMAIN, match_s=20.0), DdsLink(DOMAIN, match_s=20.0)
    received: list[Mapping[str, Any]] = []
    try:
        ours.watch("/turtle1/pose", "turtlesim/msg/Pose", received.append)
        theirs.publish("/turtle1/pose", "turtlesim/msg/Pose", {"x": 5.5, "theta": 0.25})
        assert eventually(lambda: received)[0]["theta"] == 0.25
    finally:
        ours.close()
        theirs.close()
