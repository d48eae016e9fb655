from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.base_process import base_process
from fixtures.rosbridge_server import RosbridgeServer
from fixtures.waiting import eventually

from strands_robots.ros import ros_action
from strands_robots.ros.actions import close_links
from strands_robots.tools import use_ros, use_rosbridge, use_rtps

DOMAIN = 93
ROOT = Path(__file__).resolve().parents[3]


class Operator:
    """Answers what it is asked, and remembers it."""

    def __init__(self, answer: object) -> None:
        self.answer = answer
        self.requests: list[str] = []

    def interrupt(self, name: str, reason: Any = None) -> object:
        self.requests.append(name)
        return self.answer


@pytest.fixture(autouse=True)
def closed_links() -> Iterator[None]:
    yield
    close_links()


@pytest.fixture
def server() -> Iterator[RosbridgeServer]:
    served = RosbridgeServer(
        {
            "/rosapi/topics": lambda _: {"topics": ["/odom", "/cmd_vel"], "types": ["nav_msgs/Odometry", "g/Twist"]},
            "/rosapi/nodes": lambda _: {"nodes": ["/rover"]},
            "/rosapi/services": lambda _: {"services": []},
            "/add": lambda request: {"sum": request["a"] + request["b"]},
            "/base/enable_motors": lambda _: {"armed": True},
        }
    )
    served.start()
    yield served
    served.stop()


def over(server: RosbridgeServer, action: str, **options: Any) -> dict[str, Any]:
    return ros_action(action, backend="rosbridge", host="127.0.0.1", port=server.port, **options)


def test_ros_action_lists_a_graph_behind_rosbridge(server: RosbridgeServer) -> None:
    assert over(server, "status")["topics"] == 2
    assert over(server, "list_topics")["topics"][0] == {"topic": "/cmd_vel", "type": "g/Twist"}
    assert over(server, "list_nodes")["nodes"] == ["/rover"]
    assert over(server, "list_services")["content"][0]["text"] == "No services."
    assert over(server, "info", name="/odom")["type"] == "nav_msgs/Odometry"
    assert "not on the graph" in over(server, "info", name="/nothing")["reason"]


def test_a_topic_is_echoed_with_its_bytes_counted(server: RosbridgeServer) -> None:
    done = threading.Event()

    def talk() -> None:
        while not done.wait(0.02):
            server.tell("/image", {"data": "AAAA"})

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        answer = over(server, "echo", name="/image", type="sensor_msgs/Image", count=2)
    finally:
        done.set()
        talker.join()
    assert answer["messages"] == [{"data": "3 bytes"}] * 2


def test_harmless_publish_and_call_need_no_approval(server: RosbridgeServer) -> None:
    answer = over(server, "publish", name="/chatter", type="std_msgs/String", fields={"data": "hi"}, count=3, rate=100)
    assert answer["messages"] == 3
    eventually(lambda: server.published == [("/chatter", {"data": "hi"})] * 3)
    assert over(server, "service_call", name="/add", type="p/Add", fields={"a": 1, "b": 2})["response"] == {"sum": 3}


def test_command_needs_approval_even_if_it_is_zero(server: RosbridgeServer) -> None:
    twist = {"name": "/cmd_vel", "type": "geometry_msgs/Twist", "fields": {}}
    assert "needs operator approval" in over(server, "publish", **twist)["reason"]
    no, yes = Operator("no"), Operator("yes")
    assert "did not approve" in over(server, "publish", tool_context=no, **twist)["reason"]
    assert server.published == []
    assert over(server, "publish", tool_context=yes, **twist)["status"] == "success"
    assert no.requests == yes.requests == ["ros_command:/cmd_vel"]
    motors = {"name": "/base/enable_motors", "type": "p/Enable"}
    assert "enable_motors command" in over(server, "service_call", **motors)["reason"]
    goal = {"name": "/navigate_to_pose", "type": "nav2_msgs/action/NavigateToPose"}
    assert "navigate_to_pose command" in over(server, "action_goal", **goal)["reason"]


def test_goal_reports_its_end(server: RosbridgeServer) -> None:
    ends = [4, 6]
    server.on_goal = lambda goal: [{"op": "action_result", "values": {"n": 3}, "status": ends.pop(0), "result": True}]
    answer = over(server, "action_goal", name="/count", type="p/action/Count")
    assert (answer["status"], answer["goal_status"], answer["values"]) == ("success", 4, {"n": 3})
    assert "was aborted" in over(server, "action_goal", name="/count", type="p/action/Count")["reason"]


@pytest.mark.parametrize(
    ("action", "options", "named"),
    [
        ("fly", {}, "action"),
        ("echo", {"name": "a b"}, "name"),
        ("echo", {"name": "/a", "count": 0}, "count"),
        ("echo", {"name": "/a", "timeout": float("inf")}, "timeout"),
        ("publish", {"name": "/a"}, "type"),
        ("publish", {"name": "/a", "type": "p/T", "fields": [1]}, "fields"),
        ("publish", {"name": "/a", "type": "p/T", "rate": 0}, "rate"),
        ("publish", {"name": "/a", "type": "p/T", "rate": 1e-300, "count": 2}, "rate"),
        ("echo", {"name": "/a", "timeout": 1e300}, "timeout"),
        ("status", {"backend": "ros1"}, "backend"),
        ("status", {"backend": "rosbridge", "host": "a b"}, "host"),
        ("status", {"backend": "dds", "domain_id": 300}, "domain_id"),
    ],
)
def test_an_argument_outside_its_domain_is_refused_by_name(action: str, options: dict[str, Any], named: str) -> None:
    assert ros_action(action, **options)["reason"].startswith(f"{named} must be")


def test_ros_action_lists_and_reads_a_graph_over_dds(tmp_path: Path) -> None:
    with base_process(DOMAIN):
        odom = {"topic": "/odom", "type": "nav_msgs/msg/Odometry", "publishers": 1, "subscriptions": 0}
        eventually(lambda: odom in ros_action("list_topics", domain_id=DOMAIN)["topics"])
        sample = ros_action("echo", name="/odom", domain_id=DOMAIN)["messages"][0]
        assert sample["twist"]["twist"]["linear"] == {"x": 0.0, "y": 0.0, "z": 0.0}
        for tool in (use_ros, use_rtps):
            heard = tool(action="echo", topic="/odom", timeout=20.0, domain_id=DOMAIN)
            assert heard["messages"][0]["twist"]["twist"]["linear"]["x"] == 0.0
        refused = use_rtps(action="publish", topic="/cmd_vel", type="geometry_msgs/msg/Twist", domain_id=DOMAIN)
        assert "STRANDS_ROS2_COMMAND_ALLOW" in refused["reason"]
        command = {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "fields": {"linear": {"x": 0.1}}}
        at: dict[str, Any] = {"domain_id": DOMAIN, "tool_context": Operator(True)}
        eventually(lambda: ros_action("publish", **at, **command)["status"] == "success")
    for action, options in (
        ("service_call", {"name": "/add", "type": "p/Add"}),
        ("action_goal", {"name": "/go", "type": "p/Go"}),
        ("list_nodes", {}),
        ("list_services", {}),
    ):
        assert "rosbridge" in ros_action(action, domain_id=DOMAIN, **options)["reason"]


@pytest.mark.parametrize("tool", [use_ros, use_rosbridge, use_rtps])
def test_the_tools_describe_every_parameter(tool: Any) -> None:
    schema = tool.tool_spec["inputSchema"]["json"]
    assert schema["required"] == ["action"]
    assert "tool_context" not in schema["properties"]
    for name, parameter in schema["properties"].items():
        assert len(parameter["description"]) > 10, name
        assert not parameter["description"].startswith("Parameter"), name
