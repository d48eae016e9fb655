"""Over npm's rosbridge server to a rospy base on Debian's roscore: nothing here is ours but the client."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from fixtures.ros1_graph import Ros1Graph, missing
from fixtures.ros_bases import OPEN
from fixtures.waiting import eventually
from tests.integration.ros.conftest import x_of

from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.ros.link import RosError
from strands_robots.ros.rosbridge import RosbridgeLink

pytestmark = pytest.mark.system

ODOMETRY = "nav_msgs/Odometry"


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros1Graph]:
    if why := missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    with Ros1Graph(tmp_path_factory.mktemp("ros1")) as made:
        yield made


@pytest.fixture
def base(graph: Ros1Graph) -> Iterator[RosbridgeRobot]:
    robot = RosbridgeRobot(
        "base",
        "/cmd_vel",
        "/odom",
        "/scan",
        host="127.0.0.1",
        port=graph.port,
        odom_type=ODOMETRY,
        scan_type="sensor_msgs/LaserScan",
        publish_rate=20,
        command_gate=OPEN,
    )
    yield robot
    robot.disconnect()


@pytest.fixture
def link(graph: Ros1Graph) -> Iterator[RosbridgeLink]:
    made = RosbridgeLink("127.0.0.1", graph.port)
    yield made
    made.close()


def test_rospy_base_is_driven_and_stands_afterwards(base: RosbridgeRobot) -> None:
    began = x_of(base)
    answer = base.drive(0.4, 0.0, duration=1.0)
    assert (answer["status"], answer["messages"], answer["trailing_zero"]) == ("success", 20, True)
    assert base.stop()["stopped"] is True
    # 0.4 m; less where a far end or its server is starved of its processor, or misses the first message.
    assert 0.1 < x_of(base) - began < 0.6
    stood = x_of(base)
    assert x_of(base) == stood


def test_a_stop_ends_the_drive_of_a_rospy_base(base: RosbridgeRobot) -> None:
    assert base.start_drive(1.0, 0.0, 30.0)["status"] == "success"
    began = x_of(base)
    eventually(lambda: x_of(base) > began + 0.1)
    verdict = base.halt("test")
    assert (verdict.stopped, verdict.halted) == (True, ("drive",))
    assert base.get_task_status()["task_status"] == "stopped"


def test_scan_is_read_with_null_for_infinity(base: RosbridgeRobot) -> None:
    scan = base.get_scan(20.0)["message"]
    assert scan["range_max"] == 8
    assert scan["ranges"] == [1, 2, None]


def test_services_answer_and_a_missing_one_is_an_error(link: RosbridgeLink, base: RosbridgeRobot) -> None:
    received = link.call("/stand", "std_srvs/Trigger", {}, 20.0)
    assert received == {"success": True, "message": f"{x_of(base):.3f}"}
    assert link.call("/power", "std_srvs/SetBool", {"data": True}, 20.0)["message"] == "on"
    with pytest.raises(RosError, match="/nowhere did not answer within"):
        link.call("/nowhere", "std_srvs/Trigger", {}, 0.5)


def test_server_refusal_is_reported_verbatim(link: RosbridgeLink) -> None:
    with pytest.raises(RosError, match="rosbridge says"):
        link.call("/odd", "no_srvs/Odd", {}, 20.0)
    # This server resolves no types, and says so of a subscription that has none.
    with pytest.raises(RosError, match="rosbridge says"):
        link.read("/odom", None, 20.0)


def test_restarted_server_gets_the_subscriptions_of_the_killed_one(
    graph: Ros1Graph, base: RosbridgeRobot, link: RosbridgeLink
) -> None:
    received: list[Mapping[str, Any]] = []
    link.watch("/odom", ODOMETRY, received.append)
    eventually(lambda: received)
    assert base.start_drive(0.3, 0.0, 30.0)["status"] == "success"
    eventually(lambda: received[-1]["twist"]["twist"]["linear"]["x"] > 0.2)
    graph.stop_server()
    try:
        eventually(lambda: base.get_task_status()["task_status"] == "error")
        assert base.halt().stopped is False
        with pytest.raises(RosError, match="No connection to rosbridge"):
            link.call("/stand", "std_srvs/Trigger", {}, 1.0)
    finally:
        graph.start_server()
    received.clear()
    eventually(lambda: received)
    # The base stood by its own watchdog while nobody could reach it.
    assert received[-1]["twist"]["twist"]["linear"]["x"] == 0
    eventually(lambda: base.stop()["stopped"])
    assert base.drive(0.3, 0.0, duration=0.5)["status"] == "success"


def test_an_independent_client_on_the_same_server_sees_what_we_send(graph: Ros1Graph, base: RosbridgeRobot) -> None:
    import roslibpy  # noqa: PLC0415 - its default transport starts threads when it is used

    received: list[dict[str, Any]] = []
    seen: list[float] = []
    client = roslibpy.Ros("127.0.0.1", graph.port, transport="asyncio")
    client.run(timeout=10)
    try:
        commands = roslibpy.Topic(client, "/cmd_vel", "geometry_msgs/Twist")
        odometry = roslibpy.Topic(client, "/odom", ODOMETRY)
        commands.subscribe(received.append)
        odometry.subscribe(lambda message: seen.append(message["twist"]["twist"]["linear"]["x"]))
        eventually(lambda: seen)
        assert base.drive(0.25, 0.5, duration=0.5)["status"] == "success"
        eventually(lambda: received and received[-1]["linear"]["x"] == 0)
        assert {"x": 0.25, "y": 0, "z": 0} in [each["linear"] for each in received]
        assert {"x": 0, "y": 0, "z": 0.5} in [each["angular"] for each in received]
        assert 0.25 in seen
        # And the other way round: what it drives is what we see.
        base.stop()
        stood = x_of(base)
        twist = {"linear": {"x": 0.2, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}}

        def moved() -> bool:
            # Whoever subscribes on ROS 1 meets a new publisher only some milliseconds after its first message.
            commands.publish(roslibpy.Message(twist))
            return x_of(base) != stood

        eventually(moved)
        commands.unsubscribe()
        odometry.unsubscribe()
    finally:
        client.close()
