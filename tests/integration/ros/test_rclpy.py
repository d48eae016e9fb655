"""Robots and bridges over rclpy's shape, with real DDS between them and processes that know nothing of it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclonedds import domain
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from fixtures.dds_nav2 import RELIABLE, Service
from fixtures.nav2_process import nav2
from fixtures.rclpy_stand_in.idl import SERVICES, ServoCtrlMsg
from fixtures.waiting import eventually

from fixtures import rclpy_stand_in
from strands_robots.drivers.ros.ackermann_robot import AckermannRosRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.envelope import Envelope, error, success
from strands_robots.hardware_ros_bridge import HardwareRosBridge
from strands_robots.ros import goals, ros_action
from strands_robots.ros.actions import close_links
from strands_robots.ros.dds import DdsLink, confine
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosError
from strands_robots.ros_telemetry import INSECURE, MAX_QOS_HISTORY_DEPTH
from strands_robots.simulation import Simulation
from strands_robots.simulation.ros_bridge import SimRosBridge
from strands_robots.utils import ValidationError

DOMAIN = 96
ROOT = Path(__file__).resolve().parents[3]
OPEN = CommandGate(lambda _: ("cmd_vel", "navigate_to_pose"), lambda: False)
JOINTS = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"
SECURITY = ("ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY", "ROS_SECURITY_KEYSTORE")


@pytest.fixture(autouse=True)
def confined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    for name in ("CYCLONEDDS_URI", "ROS_DOMAIN_ID", "STRANDS_ROS2_COMMAND_ALLOW", INSECURE, *SECURITY):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def sourced() -> Iterator[None]:
    """A ROS 2 that is sourced, as far as our code can tell."""
    with rclpy_stand_in.installed():
        yield
        close_links()


@pytest.fixture
def base() -> Iterator[None]:
    line = [sys.executable, "-m", "fixtures.dds_base", str(DOMAIN)]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield
        process.communicate(timeout=10)


Rover = Callable[..., RosBridgedRobot]


@pytest.fixture
def rover(sourced: None) -> Iterator[Rover]:
    robots: list[RosBridgedRobot] = []

    def make(**options: Any) -> RosBridgedRobot:
        options = {"domain_id": DOMAIN, "publish_rate": 20.0, "command_gate": OPEN, **options}
        robots.append(RosBridgedRobot("rover", "/cmd_vel", "/odom", **options))
        # The odometry's type is the graph's to tell, so that this waits for the far end as well.
        eventually(lambda: robots[-1].get_pose(1.0)["status"] == "success")
        return robots[-1]

    yield make
    for each in robots:
        each.disconnect()


def x_of(robot: RosBridgedRobot) -> float:
    return float(robot.get_pose(3.0)["message"]["pose"]["pose"]["position"]["x"])


def test_a_base_in_another_process_is_driven_and_stopped(base: None, rover: Rover) -> None:
    robot = rover()
    began = x_of(robot)
    answer = robot.drive(0.3, 0.0, duration=1.0)
    assert (answer["status"], answer["messages"], answer["trailing_zero"]) == ("success", 20, True)
    assert robot.stop()["stopped"] is True
    # A far end that is starved of its processor moves less, and none moves more.
    assert 0.05 < x_of(robot) - began < 0.36
    assert robot.start_drive(1.0, 0.0, 30.0)["status"] == "success"
    eventually(lambda: x_of(robot) > began + 0.5)
    verdict = robot.halt("test")
    assert (verdict.stopped, verdict.halted) == (True, ("drive",))


def test_a_stack_in_another_process_reaches_a_goal(rover: Rover) -> None:
    with nav2(DOMAIN, "reach") as process:
        robot = rover(nav_action="/navigate_to_pose")
        answer = robot.navigate_to(0.3, 0.4, yaw=1.0, timeout=20.0)
        assert (answer["status"], answer["goal_state"], answer["result"]["error_code"]) == ("success", "succeeded", 0)
        assert answer["feedback_count"] > 5
        assert answer["feedback"][-1]["distance_remaining"] < 0.1
        pose = robot.get_pose()["message"]["pose"]["pose"]
        assert (pose["position"]["x"], pose["position"]["y"]) == (pytest.approx(0.3), pytest.approx(0.4))
        assert robot.halt("test").stopped is True
        assert process.end() == ["goal"]


@pytest.mark.parametrize(
    ("manner", "timeout", "state", "said"),
    [
        ("abort", 10.0, "aborted", ["goal"]),
        ("reject", 10.0, "not sent", ["goal"]),
        ("stuck", 2.0, "canceled", ["goal", "cancel"]),
        ("deaf", 2.0, "lost", ["goal", "cancel"]),
    ],
)
def test_a_goal_that_is_not_reached_says_why(
    rover: Rover, manner: str, timeout: float, state: str, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(goals, "CANCEL_S", 0.3)
    with nav2(DOMAIN, manner) as process:
        robot = rover(nav_action="/navigate_to_pose")
        eventually(lambda: ros_action("list_actions", domain_id=DOMAIN)["actions"])
        answer = robot.navigate_to(100.0, 0.0, timeout=timeout)
        assert (answer["status"], answer["goal_state"]) == ("error", state)
        assert process.end() == said


def test_a_stop_cancels_the_goal_of_a_stack_in_another_process(rover: Rover) -> None:
    with nav2(DOMAIN, "stuck") as process:
        robot = rover(nav_action="/navigate_to_pose")
        answers: list[Envelope] = []
        thread = threading.Thread(target=lambda: answers.append(robot.navigate_to(100.0, 0.0)))
        thread.start()
        eventually(lambda: robot.get_task_status().get("step_count", 0) > 3)
        verdict = robot.halt("test")
        thread.join(5)
        assert (verdict.stopped, verdict.halted) == (True, ("navigation",))
        assert (answers[0]["goal_state"], answers[0]["ended_by"]) == ("canceled", "a stop")
        speed = robot.get_pose()["message"]["twist"]["twist"]["linear"]["x"]
        assert (speed, process.end()) == (0.0, ["goal", "cancel"])


def test_a_graph_is_looked_at_read_and_asked_through_ros_action(sourced: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ROS2_COMMAND_ALLOW", "navigate_to_pose")
    at: dict[str, Any] = {"domain_id": DOMAIN, "timeout": 30.0}
    with nav2(DOMAIN, "reach"):
        eventually(lambda: ros_action("list_actions", **at)["actions"] == ["/navigate_to_pose"])
        assert ros_action("status", **at)["backend"] == "RclpyLink"
        assert ros_action("list_nodes", **at)["nodes"] == ["/strands_robots"]
        assert ros_action("list_services", **at)["services"] == ["/arm"]
        assert ros_action("info", name="/odom", **at)["type"] == "nav_msgs/msg/Odometry"
        assert len(ros_action("echo", name="/odom", count=2, **at)["messages"]) == 2
        asked = ros_action("service_call", name="/arm", type="std_srvs/srv/SetBool", fields={"data": True}, **at)
        assert asked["response"] == {"success": True, "message": "armed"}
        kind = "nav2_msgs/action/NavigateToPose"
        goal = {"pose": {"pose": {"position": {"x": 0.05}}}}
        done = ros_action("action_goal", name="/navigate_to_pose", type=kind, fields=goal, **at)
        assert (done["status"], done["goal_status"]) == ("success", 4)
    unknown = ros_action("publish", name="/a", type="p/msg/Unknown", **at)
    assert "p/msg/Unknown is not installed" in unknown["reason"]
    wrong = ros_action("publish", name="/a", type="std_msgs/msg/String", fields={"data": 1}, **at)
    assert wrong["reason"].endswith("data must be a string, not 1.")


class Arm:
    """Takes actions and keeps them; refuses while locked."""

    tool_name_str = "my arm"

    def __init__(self) -> None:
        self.taken: list[dict[str, float]] = []
        self.locked = False

    def send_action(self, action: dict[str, float]) -> dict[str, Any]:
        if self.locked:
            return error("locked")
        self.taken.append(action)
        return success("taken")


@pytest.fixture
def peer() -> Iterator[DdsLink]:
    link = DdsLink(DOMAIN, match_s=5.0)
    yield link
    link.close()


def test_a_joint_command_of_a_dds_peer_drives_the_arm_whole_or_not_at_all(
    sourced: None, peer: DdsLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INSECURE, "1")
    arm = Arm()
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
    assert not [t for t in threading.enumerate() if t.name.startswith(("strands_hardware", "rclpy-strands_hardware"))]


def test_a_bridge_without_a_robot_tells_joints_and_images_to_a_dds_peer(sourced: None, peer: DdsLink) -> None:
    bridge = HardwareRosBridge(domain_id=DOMAIN)
    heard: dict[str, Any] = {}
    peer.watch("/my_arm/joint_states", JOINTS, lambda m: heard.update(joints=m))
    peer.watch("/my_arm/front/image_raw", IMAGE, lambda m: heard.update(image=m))
    picture = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)

    def told() -> bool:
        bridge.publish_joint_states("my arm", ["a.pos"], [0.25])
        bridge.publish_joint_states("my arm", ["a.pos", "b.pos"], [9.0])
        bridge.publish_image("my arm", "front", picture)
        bridge.publish_image("my arm", "front", picture[:, :, 0])
        return len(heard) == 2

    try:
        eventually(told)
        joints, image = heard["joints"], heard["image"]
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
def test_a_bridge_that_cannot_be_is_refused_before_ros_2_is_looked_for(
    options: dict[str, Any], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INSECURE, "1")
    before, threads = dict(os.environ), threading.active_count()
    with pytest.raises(ValidationError, match=named):
        HardwareRosBridge(Arm(), **{"domain_id": DOMAIN, **options})
    assert (dict(os.environ), threading.active_count()) == (before, threads)


def test_commands_on_an_unsecured_graph_are_refused_until_somebody_insists_or_secures_it(
    sourced: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    secured = dict(zip(SECURITY, ("true", "Enforce", str(tmp_path)), strict=True))
    for weak in ({}, {"ROS_SECURITY_ENABLE": "True"}, {"ROS_SECURITY_STRATEGY": "enforce"}, {SECURITY[2]: "/nowhere"}):
        with monkeypatch.context() as patched:
            for name, value in {**secured, **weak}.items() if weak else []:
                patched.setenv(name, value)
            with pytest.raises(ValidationError, match=INSECURE):
                HardwareRosBridge(Arm(), domain_id=DOMAIN)
    HardwareRosBridge(Arm(), domain_id=DOMAIN, enable_commands=False).shutdown()
    for name, value in secured.items():
        monkeypatch.setenv(name, value)
    # The graph counts as secured; joining it is the middleware's, and the stand-in joins open ones only.
    with pytest.raises(RosError, match="open graphs only"):
        HardwareRosBridge(Arm(), domain_id=DOMAIN)


def test_without_a_ros_2_each_bridge_says_so_in_one_sentence() -> None:
    for make in (HardwareRosBridge, SimRosBridge):
        with pytest.raises(RosError, match="source a ROS 2 installation"):
            make(domain_id=DOMAIN)


def test_a_simulation_tells_its_joints_and_a_camera_to_a_dds_peer(sourced: None, peer: DdsLink) -> None:
    world = Simulation("bench")
    world.add_robot("arm", "so100")
    bridge = SimRosBridge(world, domain_id=DOMAIN)
    heard: dict[str, Any] = {}
    peer.watch("/arm/joint_states", JOINTS, lambda m: heard.update(joints=m))
    peer.watch("/bench/overview/image_raw", IMAGE, lambda m: heard.update(image=m))
    try:
        bridge.start(20.0, ["overview"])
        with pytest.raises(ValidationError, match="called before"):
            bridge.start()
        eventually(lambda: len(heard) == 2, within=20.0)
        observed = world.get_observation("arm")
        told = dict(zip(heard["joints"]["name"], heard["joints"]["position"], strict=True))
        assert told == pytest.approx({name: observed[name] for name in told}, abs=0.05)
        assert len(told) == 6
        assert (heard["image"]["width"], heard["image"]["height"]) == (320, 240)
    finally:
        bridge.shutdown()
        bridge.shutdown()
        world.cleanup()


@pytest.fixture
def car() -> Iterator[list[Any]]:
    """A DeepRacer's graph on plain DDS: it notes each service that it was asked, and each servo message."""
    confine(domain, DOMAIN)
    participant = DomainParticipant(DOMAIN)
    asked: list[Any] = []
    services = {
        name: Service(participant, f"/ctrl_pkg/{name}", SERVICES[f"deepracer_interfaces_pkg/{kind}"])
        for name, kind in (("vehicle_state", "ActiveStateSrv"), ("enable_state", "EnableStateSrv"))
    }
    servo = DataReader(participant, Topic(participant, "rt/webserver_pkg/manual_drive", ServoCtrlMsg), qos=RELIABLE)
    done = threading.Event()

    def serve() -> None:
        while not done.wait(0.002):
            for name, service in services.items():
                for request in service.asked():
                    asked.append(name)
                    service.answer(request, error=0)
            told = [each for each in servo.take(N=100) if each.sample_info.valid_data]
            asked.extend((round(each.angle, 3), round(each.throttle, 3)) for each in told)

    thread = threading.Thread(target=serve)
    thread.start()
    yield asked
    done.set()
    thread.join()


def test_a_car_is_armed_once_by_its_services_and_steered(
    sourced: None, car: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    leave = CommandGate(lambda _: ("manual_drive", "vehicle_state", "enable_state"), lambda: False)
    racer = AckermannRosRobot.from_deepracer("racer", command_gate=leave)
    try:
        assert racer.drive(0.75, 0.0, duration=0.1)["status"] == "success"
        eventually(lambda: len(car) == 5)
        assert car == ["vehicle_state", "enable_state", (0.0, 0.5), (0.0, 0.5), (0.0, 0.0)]
        assert racer.drive(0.75, 100.0, count=2)["status"] == "success"
        eventually(lambda: len(car) == 8)
        assert car[5:] == [(1.0, 0.5), (1.0, 0.5), (0.0, 0.0)]
    finally:
        racer.disconnect()
