"""Robots and bridges over rclpy's shape, with real DDS between them and processes that know nothing of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cyclonedds import domain
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from fixtures import rclpy_stand_in
from fixtures.base_process import base_process, nav2
from fixtures.dds_nav2 import RELIABLE, Service
from fixtures.rclpy_stand_in.idl import SERVICES, ServoCtrlMsg
from fixtures.waiting import eventually
from tests.integration.ros.conftest import x_of

from strands_robots.drivers.ros.ackermann_robot import AckermannRosRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.envelope import Envelope
from strands_robots.ros import ros_action
from strands_robots.ros.actions import close_links
from strands_robots.ros.dds import confine
from strands_robots.ros.dds_types import KINDS
from strands_robots.ros.gate import CommandGate

DOMAIN = 86
ROOT = Path(__file__).resolve().parents[3]
OPEN = CommandGate(lambda _: ("cmd_vel", "navigate_to_pose"), lambda: False)
JOINTS = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"
SECURITY = ("ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY", "ROS_SECURITY_KEYSTORE")


@pytest.fixture
def sourced() -> Iterator[None]:
    """A ROS 2 that is sourced, as far as our code can tell."""
    with rclpy_stand_in.installed():
        yield
        close_links()


@pytest.fixture
def base() -> Iterator[None]:
    with base_process(DOMAIN):
        yield


Rover = Callable[..., RosBridgedRobot]


@pytest.fixture
def rover(sourced: None) -> Iterator[Rover]:
    robots: list[RosBridgedRobot] = []

    def make(**options: Any) -> RosBridgedRobot:
        options = {"domain_id": DOMAIN, "publish_rate": 20.0, "command_gate": OPEN, **options}
        robots.append(RosBridgedRobot("rover", "/cmd_vel", "/odom", **options))
        # The odometry's type is the graph's to tell, so that this waits for the far end as well.
        eventually(lambda: robots[-1].get_pose(2.0)["status"] == "success")
        return robots[-1]

    yield make
    for each in robots:
        each.disconnect()


@pytest.mark.usefixtures("patient")
def test_a_base_in_another_process_is_driven_and_stopped(base: None, rover: Rover) -> None:
    robot = rover()
    began, called = x_of(robot), time.monotonic()
    answer = robot.drive(0.3, 0.0, duration=1.0)
    took_s = time.monotonic() - called
    assert (answer["status"], answer["messages"], answer["trailing_zero"]) == ("success", 20, True)
    assert robot.stop()["stopped"] is True
    # 0.3 m; less where a far end misses the first messages, more where the burst is held up and holds its velocity.
    assert 0.05 < x_of(robot) - began < 0.3 * max(1.0, took_s) + 0.06
    assert robot.start_drive(1.0, 0.0, 30.0)["status"] == "success"
    eventually(lambda: x_of(robot) > began + 0.5)
    verdict = robot.halt("test")
    assert (verdict.stopped, verdict.halted) == (True, ("drive",))


def test_a_stack_in_another_process_reaches_a_goal(rover: Rover) -> None:
    with nav2(DOMAIN, "reach") as process:
        robot = rover(nav_action="/navigate_to_pose")
        answer = robot.navigate_to(0.3, 0.4, yaw=1.0, timeout=60.0)
        assert answer["goal_state"] == "succeeded", answer
        assert (answer["status"], answer["result"]["error_code"]) == ("success", 0)
        assert answer["feedback_count"] > 5
        left = [each["distance_remaining"] for each in answer["feedback"]]
        assert 0.5 > left[0] > left[-1]
        assert left == sorted(left, reverse=True)
        pose = robot.get_pose()["message"]["pose"]["pose"]
        assert (pose["position"]["x"], pose["position"]["y"]) == (pytest.approx(0.3), pytest.approx(0.4))
        assert robot.halt("test").stopped is True
        assert process.end() == ["goal"]


@pytest.mark.parametrize(
    ("manner", "timeout", "state", "said"),
    [
        ("abort", 40.0, "aborted", ["goal"]),
        ("reject", 40.0, "not sent", ["goal"]),
        ("stuck", 4.0, "canceled", ["goal", "cancel"]),
        ("deaf", 4.0, "lost", ["goal", "cancel"]),
    ],
)
def test_goal_that_is_not_reached_gives_the_reason(
    rover: Rover, manner: str, timeout: float, state: str, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if manner == "deaf":
        monkeypatch.setattr("strands_robots.ros.link.CANCEL_S", 1.0)
    with nav2(DOMAIN, manner) as process:
        robot = rover(nav_action="/navigate_to_pose")
        eventually(lambda: ros_action("list_actions", domain_id=DOMAIN)["actions"])
        answer = robot.navigate_to(100.0, 0.0, timeout=timeout)
        assert (answer["status"], answer["goal_state"]) == ("error", state), answer
        assert process.end() == said


def test_lost_result_is_requested_again(rover: Rover) -> None:
    with nav2(DOMAIN, "forgetful"):
        robot = rover(nav_action="/navigate_to_pose")
        answer = robot.navigate_to(0.05, 0.0, timeout=4.0)
        assert (answer["goal_state"], answer["ended_by"]) == ("succeeded", "its time of 4 s"), answer


@pytest.mark.usefixtures("patient")
def test_a_stop_cancels_the_goal_of_a_stack_in_another_process(rover: Rover) -> None:
    with nav2(DOMAIN, "stuck") as process:
        robot = rover(nav_action="/navigate_to_pose")
        answers: list[Envelope] = []
        thread = threading.Thread(target=lambda: answers.append(robot.navigate_to(100.0, 0.0)))
        thread.start()
        eventually(lambda: robot.get_task_status().get("step_count", 0) > 3)
        verdict = robot.halt("test")
        thread.join(40)
        assert (verdict.stopped, verdict.halted) == (True, ("navigation",))
        assert (answers[0]["goal_state"], answers[0]["ended_by"]) == ("canceled", "a stop")
        speed = robot.get_pose()["message"]["twist"]["twist"]["linear"]["x"]
        assert (speed, process.end()) == (0.0, ["goal", "cancel"])


def test_ros_action_lists_reads_and_calls_a_graph(sourced: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ROS2_COMMAND_ALLOW", "navigate_to_pose")
    at: dict[str, Any] = {"domain_id": DOMAIN, "timeout": 30.0}
    with nav2(DOMAIN, "reach"):
        eventually(lambda: ros_action("list_actions", **at)["actions"] == ["/navigate_to_pose"])
        assert ros_action("status", **at)["backend"] == "RclpyLink"
        assert ros_action("list_nodes", **at)["nodes"] == ["/strands_robots"]
        eventually(lambda: ros_action("list_services", **at)["services"] == ["/arm"])
        eventually(lambda: ros_action("info", name="/odom", **at).get("type") == "nav_msgs/msg/Odometry")
        assert len(ros_action("echo", name="/odom", count=2, **at)["messages"]) == 2
        requests = ros_action("service_call", name="/arm", type="std_srvs/srv/SetBool", fields={"data": True}, **at)
        assert requests["response"] == {"success": True, "message": "armed"}
        kind = "nav2_msgs/action/NavigateToPose"
        goal = {"pose": {"pose": {"position": {"x": 0.05}}}}
        done = ros_action("action_goal", name="/navigate_to_pose", type=kind, fields=goal, **at)
        assert (done["status"], done["goal_status"]) == ("success", 4)
    unknown = ros_action("publish", name="/a", type="p/msg/Unknown", **at)
    assert "p/msg/Unknown is not installed" in unknown["reason"]
    wrong = ros_action("publish", name="/a", type="std_msgs/msg/String", fields={"data": 1}, **at)
    assert wrong["reason"].endswith("data must be a string, not 1.")


@pytest.fixture
def car() -> Iterator[list[Any]]:
    """A DeepRacer's graph on plain DDS: it notes each service request and each servo message."""
    confine(domain, DOMAIN)
    participant = DomainParticipant(DOMAIN)
    requests: list[Any] = []
    services = {
        name: Service(participant, f"/ctrl_pkg/{name}", SERVICES[f"deepracer_interfaces_pkg/{kind}"])
        for name, kind in (("vehicle_state", "ActiveStateSrv"), ("enable_state", "EnableStateSrv"))
    }
    servo = DataReader(participant, Topic(participant, "rt/webserver_pkg/manual_drive", ServoCtrlMsg), qos=RELIABLE)
    done = threading.Event()

    def serve() -> None:
        while not done.wait(0.002):
            for name, service in services.items():
                for request in service.requests():
                    requests.append(name)
                    service.answer(request, error=0)
            commands = [each for each in servo.take(N=100) if each.sample_info.valid_data]
            requests.extend((round(each.angle, 3), round(each.throttle, 3)) for each in commands)

    thread = threading.Thread(target=serve)
    thread.start()
    yield requests
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


def test_latched_topic_is_read_after_its_only_message(sourced: None) -> None:
    participant = DomainParticipant(DOMAIN)
    struct = KINDS["std_msgs/String"]
    latching = Qos(Policy.Durability.TransientLocal, Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(1))
    writer = DataWriter(participant, Topic(participant, "rt/robot_description", struct), qos=latching)
    writer.write(struct(data="<robot/>"))
    answer = ros_action(
        "echo", name="/robot_description", type="std_msgs/msg/String", backend="rclpy", domain_id=DOMAIN, timeout=20.0
    )
    assert answer["messages"] == [{"data": "<robot/>"}]
