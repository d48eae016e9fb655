from __future__ import annotations

import base64
import contextlib
import json
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from fixtures.ros_bases import OPEN
from fixtures.rosbridge_server import RosbridgeServer
from fixtures.waiting import eventually, free_port

from strands_robots.drivers.ros import velocity
from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.ros.link import RosError, run_goal
from strands_robots.ros.rosbridge import RosbridgeLink
from strands_robots.safety.orders import StopOrder
from strands_robots.safety.plane import SafetyPlane
from strands_robots.utils import ValidationError

TWIST = "geometry_msgs/Twist"


def refused(request: Mapping[str, Any]) -> dict[str, Any]:
    raise ValueError(f"will not {request['verb']}")


@pytest.fixture
def server() -> Iterator[RosbridgeServer]:
    served = RosbridgeServer({"/add": lambda r: {"sum": r["a"] + r["b"]}, "/refuse": refused})
    served.start()
    yield served
    served.stop()


@pytest.fixture
def link(server: RosbridgeServer) -> Iterator[RosbridgeLink]:
    made = RosbridgeLink("127.0.0.1", server.port)
    yield made
    made.close()


@pytest.fixture
def rover(server: RosbridgeServer) -> Iterator[RosbridgeRobot]:
    robot = RosbridgeRobot(
        "rover", "/cmd_vel", "/odom", "/scan", host="127.0.0.1", port=server.port, publish_rate=50, command_gate=OPEN
    )
    yield robot
    robot.disconnect()


def test_a_topic_is_advertised_once_and_then_published_on(server: RosbridgeServer, link: RosbridgeLink) -> None:
    for n in range(3):
        link.publish("/count", "std_msgs/Int32", {"data": n})
    eventually(lambda: server.published == [("/count", {"data": n}) for n in range(3)])
    assert [op["type"] for op in server.seen("advertise")] == ["std_msgs/Int32"]


def test_a_service_answers_and_its_failure_is_an_error(link: RosbridgeLink) -> None:
    assert link.call("/add", "pkg/Add", {"a": 2, "b": 3}, 20.0) == {"sum": 5}
    with pytest.raises(RosError, match="will not jump"):
        link.call("/refuse", "pkg/Refuse", {"verb": "jump"}, 20.0)


def test_status_error_fails_its_request_at_once(link: RosbridgeLink) -> None:
    began = time.monotonic()
    with pytest.raises(RosError, match="no service /nobody"):
        link.call("/nobody", "pkg/Nobody", {}, 60.0)
    with pytest.raises(RosError, match="unknown topic type"):
        link.read("/unknown", None, 60.0)
    assert time.monotonic() - began < 30


def test_a_status_error_of_a_publish_fails_the_next_one(server: RosbridgeServer, link: RosbridgeLink) -> None:
    link.publish("/forbidden", TWIST, {})

    def fails() -> bool:
        try:
            link.publish("/forbidden", TWIST, {})
        except RosError as exc:
            return "is not yours" in str(exc)
        return False

    eventually(fails)


def test_a_message_is_read_with_its_bytes_decoded(server: RosbridgeServer, link: RosbridgeLink) -> None:
    done = threading.Event()

    def talk() -> None:
        while not done.wait(0.02):
            server.tell("/image", {"width": 2, "data": base64.b64encode(b"\x00\xff").decode()})

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        assert link.read("/image", "sensor_msgs/msg/Image", 20.0) == {"width": 2, "data": b"\x00\xff"}
    finally:
        done.set()
        talker.join()
    eventually(lambda: server.seen("unsubscribe"), what="a read leaves no subscription behind")


def test_bytes_go_out_as_base64_and_a_nan_not_at_all(server: RosbridgeServer, link: RosbridgeLink) -> None:
    link.publish("/image", "sensor_msgs/Image", {"data": b"\x01\x02"})
    eventually(lambda: server.published == [("/image", {"data": "AQI="})])
    with pytest.raises(RosError, match="JSON"):
        link.publish("/number", "std_msgs/Float32", {"data": float("nan")})


def test_fragments_are_put_together_in_any_order(server: RosbridgeServer, link: RosbridgeLink) -> None:
    received: list[Mapping[str, Any]] = []
    link.watch("/long", "std_msgs/String", received.append)
    eventually(lambda: server.seen("subscribe"))
    whole = json.dumps({"op": "publish", "topic": "/long", "msg": {"data": "word " * 50}})
    for number, part in ((1, whole[40:]), (0, whole[:40])):
        server.send({"op": "fragment", "id": "7", "num": number, "total": 2, "data": part})
    eventually(lambda: received == [{"data": "word " * 50}])


@pytest.mark.parametrize(
    "frame",
    ["{", "[]", '{"no": "op"}', '{"op": "publish"}', '{"op": "fragment", "id": "1", "num": 2, "total": 1}',
     '{"op": "service_response", "id": []}', '{"op": "publish", "topic": "/t", "msg": 3}', "[" * 5000],
)  # fmt: skip
def test_malformed_frame_is_ignored(server: RosbridgeServer, link: RosbridgeLink, frame: str) -> None:
    received: list[Mapping[str, Any]] = []
    link.watch("/t", None, received.append)
    eventually(lambda: server.seen("subscribe"))
    server.send(frame)
    server.tell("/t", {"data": 1})
    eventually(lambda: received == [{"data": 1}])


def test_lost_server_refuses_at_once_and_is_reconnected_with_its_subscriptions(
    server: RosbridgeServer, link: RosbridgeLink
) -> None:
    received: list[Mapping[str, Any]] = []
    link.watch("/odom", "nav_msgs/Odometry", received.append)
    link.publish("/cmd_vel", TWIST, {})
    eventually(lambda: server.tell("/odom", {"n": 1}) and received)
    server.stop()

    def refuses() -> bool:
        try:
            link.publish("/cmd_vel", TWIST, {})
        except RosError:
            return True
        return False

    eventually(refuses)
    server.ops.clear()
    received.clear()
    server.start()
    eventually(lambda: server.tell("/odom", {"n": 2}) and received)
    link.publish("/cmd_vel", TWIST, {"back": 1})
    eventually(lambda: ("/cmd_vel", {"back": 1}) in server.published)
    assert [op["topic"] for op in server.seen("advertise")] == ["/cmd_vel"]


def test_missing_server_is_an_error_and_can_be_connected_later() -> None:
    port = free_port()
    link = RosbridgeLink("127.0.0.1", port, connect_s=20.0)
    with pytest.raises(RosError, match=f"127.0.0.1:{port}"):
        link.publish("/cmd_vel", TWIST, {})
    server = RosbridgeServer()
    server.port = port
    server.start()
    try:
        link.publish("/cmd_vel", TWIST, {})
        eventually(lambda: server.published)
    finally:
        link.close()
        server.stop()
    eventually(lambda: not [t for t in threading.enumerate() if t.name == "rosbridge"])


@pytest.mark.parametrize(
    "where", [{"host": "ws://robot"}, {"host": "a b"}, {"host": ""}, {"port": 0}, {"port": 70000}, {"port": True}]
)
def test_invalid_host_or_port_is_refused_at_construction(where: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(where))):
        RosbridgeRobot("rover", "/cmd_vel", "/odom", **where)


def test_an_action_goal_reports_feedback_and_its_end(server: RosbridgeServer, link: RosbridgeLink) -> None:
    server.on_goal = lambda goal: [
        {"op": "action_feedback", "values": {"left": goal["args"]["metres"]}},
        {"op": "action_result", "values": {"ok": 1}, "status": 4, "result": True},
    ]
    feedback: list[Mapping[str, Any]] = []
    report = run_goal(link, "/go", "pkg/action/Go", {"metres": 2}, 20.0, feedback=feedback.append)
    assert (report.state, report.over, report.values) == ("succeeded", True, {"ok": 1})
    assert feedback == [{"left": 2}]


def test_an_action_goal_that_does_not_end_is_cancelled(
    server: RosbridgeServer, link: RosbridgeLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("strands_robots.ros.link.CANCEL_S", 0.1)
    assert link.call("/add", "pkg/Add", {"a": 2, "b": 3}, 20.0), "connected, so that the short time is the goal's own"
    report = run_goal(link, "/go", "pkg/action/Go", {}, 0.5)
    assert (report.state, report.over, report.ended_by) == ("lost", False, "its time of 0.5 s")
    cancelled = eventually(lambda: server.seen("cancel_action_goal"))
    assert cancelled[0]["id"] == server.seen("send_action_goal")[0]["id"]


def test_a_goal_whose_server_dies_is_lost_and_not_reached(server: RosbridgeServer, link: RosbridgeLink) -> None:
    sent = link.send_goal("/go", "pkg/action/Go", {}, 20.0)
    eventually(lambda: server.seen("send_action_goal"))
    server.stop()
    eventually(sent.done.is_set)
    assert "was lost" in sent.problem
    server.start()


def standing(server: RosbridgeServer) -> None:
    """Let the server stand for a base that does at once what it is commanded, with odometry."""

    def obey(topic: str, message: dict[str, Any]) -> None:
        if topic == "/cmd_vel":
            server.tell("/odom", {"twist": {"twist": {"linear": message["linear"], "angular": message["angular"]}}})

    server.on_publish = obey


def test_rover_is_driven_and_stopped_with_odometry(server: RosbridgeServer, rover: RosbridgeRobot) -> None:
    standing(server)
    answer = rover.drive(9.0, -9.0, duration=0.1)
    assert (answer["status"], answer["linear"], answer["angular"]) == ("success", 2.0, -1.0)
    eventually(lambda: len(server.published) == 6)
    assert [m["linear"]["x"] for _, m in server.published] == [2.0] * 5 + [0.0]
    rover.start_drive(0.5, 0.0, 20.0)
    eventually(lambda: server.published[-1][1]["linear"]["x"] == 0.5)
    verdict = rover.stop()
    assert (verdict["stopped"], verdict["halted"]) == (True, ["drive"])
    # The zero behind the commands may come later than the urgent one.
    eventually(lambda: server.published[-1][1]["linear"]["x"] == 0.0)


def test_drive_whose_server_is_killed_says_that_the_base_may_still_move(
    server: RosbridgeServer, rover: RosbridgeRobot
) -> None:
    answers: list[dict[str, Any]] = []
    driving = threading.Thread(target=lambda: answers.append(rover.drive(0.5, duration=20.0)))
    driving.start()
    eventually(lambda: server.published)
    server.stop()
    driving.join(40)
    assert "may still move" in answers[0]["reason"]
    assert rover.halt().stopped is False
    server.published.clear()
    server.start()
    eventually(lambda: server.published, what="the hold's zero on the new connection")
    assert server.published[0][1]["linear"]["x"] == 0.0


def test_server_that_returns_under_the_lockout_gets_only_zeros_for_the_whole_hold_time(
    server: RosbridgeServer, rover: RosbridgeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(velocity, "BLIND_HOLD_S", 1.0)
    plane = SafetyPlane(deadline_s=1.0)
    entry = plane.register("rover-1", rover)
    try:
        assert rover.start_drive(0.5, 0.0, 20.0)["status"] == "success"
        eventually(lambda: server.published)
        server.stop()
        report = plane.emergency_stop(StopOrder("e" * 32, "console", "test"))["rover-1"]
        assert report.verdict.stopped is False
        down = time.monotonic()
        eventually(lambda: time.monotonic() > down + 3 * velocity.BLIND_HOLD_S, what="longer than a blind hold")
        assert rover.holding
        server.published.clear()
        taken: list[float] = []
        server.on_publish = lambda topic, message: taken.append(time.monotonic())
        server.start()
        eventually(lambda: not rover.holding, what="the end of the hold on the new connection")
        assert taken[-1] - taken[0] > 0.5 * velocity.BLIND_HOLD_S
        assert {message["linear"]["x"] for _, message in server.published} == {0.0}
        assert "e" * 32 in rover.drive(0.5)["reason"]
        assert "rover-1" in plane.clear_local("test")
        # The hold's zeros have a connection of their own; the drive's comes back by itself.
        answers: list[dict[str, Any]] = []

        def driven() -> bool:
            answers.append(dict(rover.drive(0.5, duration=0.1)))
            return answers[-1]["status"] == "success"

        eventually(driven, what=f"a drive after the clearing, and not {answers}")
    finally:
        entry.close()


def test_curiosity_is_wired_to_its_simulation() -> None:
    rover = RosbridgeRobot.from_curiosity(max_linear=0.5)
    assert (rover.node_name, rover.max_linear, rover.max_angular, rover.max_duration) == ("curiosity", 0.5, 1.0, 30.0)
    assert rover.reads == ("get_pose",)


def test_clogged_connection_delays_neither_a_stop_nor_its_verdict(server: RosbridgeServer) -> None:
    robot = RosbridgeRobot("rover", "/cmd_vel", "/odom", host="127.0.0.1", port=server.port, command_gate=OPEN)
    server.on_publish = lambda topic, twist: server.tell("/odom", {"twist": {"twist": twist}})
    try:
        assert robot.start_drive(0.5, 0.0, 30.0)["status"] == "success"
        eventually(lambda: server.published and len(server.seen("advertise")) == 2)
        server.clog()
        # More than the sockets' buffers hold, so that whoever writes there next is stuck.
        picture = {"data": bytes(12 * 2**20)}
        stuffing = threading.Thread(target=lambda: stuffed(robot.link, picture))
        stuffing.start()
        eventually(lambda: stuck(robot))
        before = len(server.ops)
        robot.halt("test")
        first = eventually(lambda: [each for each in server.ops[before:] if each["op"] == "publish"])[0]
        assert first["topic"] == "/cmd_vel"
        assert not any(first["msg"]["linear"].values())
        # The name of the topic is in the ids of the first connection only.
        assert "cmd_vel" not in first["id"]
        stuffing.join(40)
        assert not stuffing.is_alive()
        assert not any(each["msg"]["linear"]["x"] for each in server.ops[before:] if each["op"] == "publish")
        eventually(lambda: robot.halt("again").stopped)
    finally:
        robot.disconnect()


def test_clogged_link_can_be_closed(server: RosbridgeServer, link: RosbridgeLink) -> None:
    chatters: list[threading.Thread] = []

    def stuck_in_one() -> bool:
        # A connection that its own keepalive ended while the server was slow is clogged anew.
        before = len(server.seen("publish"))
        try:
            link.publish("/chatter", "std_msgs/String", {"data": "first"})
        except RosError:
            return False
        eventually(lambda: len(server.seen("publish")) > before)
        chatters.append(threading.Thread(target=lambda: stuffed(link, {"data": bytes(12 * 2**20)})))
        chatters[-1].start()
        server.clog()
        chatters[-1].join(1.0)
        return chatters[-1].is_alive()

    eventually(stuck_in_one)
    link.close()
    chatters[-1].join(40)
    assert not chatters[-1].is_alive()


def stuck(robot: RosbridgeRobot) -> bool:
    sent = robot.get_task_status()["step_count"]
    # Longer than a picture keeps the processor from the drive.
    time.sleep(1.5)
    return bool(robot.get_task_status()["step_count"] == sent)


def stuffed(link: RosbridgeLink, picture: Mapping[str, Any]) -> None:
    # A publish that the end of the connection meets on its way fails; one that comes after it finds a new connection.
    with contextlib.suppress(RosError):
        for _ in range(4):
            link.publish("/picture", "sensor_msgs/Image", picture)
