"""The rosbridge client against a stand-in of rosbridge_suite, which reports no error by ``status``."""

from __future__ import annotations

import signal
import ssl
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from fixtures.certificates import Authority
from fixtures.child import Child
from fixtures.ros_bases import OPEN
from fixtures.rosbridge_suite import RosbridgeSuite
from fixtures.waiting import eventually

from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.ros import rosbridge_session
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosError, run_goal
from strands_robots.ros.rosbridge import RosbridgeLink
from strands_robots.ros.rosbridge_session import RosbridgeAccess
from strands_robots.utils import ValidationError

TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the client ask more often than once a second."""
    monkeypatch.setattr(rosbridge_session, "TICK_S", 0.05)


@pytest.fixture
def server() -> Iterator[RosbridgeSuite]:
    served = RosbridgeSuite({"/odom": "nav_msgs/msg/Odometry", "/scan": TWIST}, hidden=("/hidden",))
    served.start()
    yield served
    served.stop()


@pytest.fixture
def link(server: RosbridgeSuite) -> Iterator[RosbridgeLink]:
    made = RosbridgeLink("127.0.0.1", server.port, connect_s=20.0)
    yield made
    made.close()


def refused(link: RosbridgeLink, topic: str, kind: str, why: str) -> None:
    """Publish until the link says why that is no use; on a busy machine its connection may break meanwhile."""
    said = list[str]()

    def told() -> bool:
        try:
            link.publish(topic, kind, {})
        except RosError as exc:
            said.append(str(exc))
        return any(why in each for each in said)

    eventually(told, 60.0, what=f"{why!r}")


@pytest.mark.parametrize("why", ["No action server available", "Action goal was rejected"])
def test_goal_that_was_not_taken_is_over(server: RosbridgeSuite, link: RosbridgeLink, why: str) -> None:
    server.on_goal = lambda goal: [{"op": "action_result", "values": why, "status": 0, "result": False}]
    report = run_goal(link, "/go", "pkg/action/Go", {}, 20.0)
    assert (report.state, report.over) == ("rejected", True)
    assert why in report.sentence()


def test_stop_after_a_goal_that_was_not_taken_is_a_stop(server: RosbridgeSuite, link: RosbridgeLink) -> None:
    server.on_goal = lambda goal: [{"op": "action_result", "values": "no server", "status": 0, "result": False}]
    server.on_publish = lambda topic, twist: server.tell("/odom", {"twist": {"twist": twist}})
    rover = RosBridgedRobot(
        "rover",
        "/cmd_vel",
        "/odom",
        odom_type="nav_msgs/msg/Odometry",
        nav_action="/go",
        link=link,
        command_gate=CommandGate(lambda _: ("cmd_vel", "navigate_to_pose"), lambda: False),
    )
    try:
        assert rover.navigate_to(1.0, 0.0, timeout=20.0)["goal_state"] == "rejected"
        eventually(lambda: rover.halt("test").stopped)
    finally:
        rover.disconnect()


def test_silently_refused_publisher_is_found_by_asking(link: RosbridgeLink) -> None:
    refused(link, "/hidden", TWIST, "has no publisher on /hidden")


def test_publisher_of_another_type_is_found_by_asking(link: RosbridgeLink) -> None:
    refused(link, "/odom", TWIST, "carries nav_msgs/msg/Odometry")


def test_accepted_publisher_is_asked_about_until_it_is_there(server: RosbridgeSuite, link: RosbridgeLink) -> None:
    link.publish("/cmd_vel", TWIST, {})
    eventually(lambda: len(server.seen("call_service")) >= 2)
    link.publish("/cmd_vel", TWIST, {"again": 1})
    eventually(lambda: ("/cmd_vel", {"again": 1}) in server.published)


def test_topic_that_appears_later_is_found(server: RosbridgeSuite, link: RosbridgeLink) -> None:
    received: list[Mapping[str, Any]] = []
    link.watch("/late", None, received.append)
    eventually(lambda: server.seen("subscribe"))
    assert server.tell("/late", {}) == 0
    server.graph["/late"] = "std_msgs/msg/String"
    eventually(lambda: server.tell("/late", {"data": "here"}) and received)


def test_frozen_server_is_a_base_that_did_not_stop() -> None:
    with Child("fixtures.rosbridge_suite", {}) as suite:
        robot = RosbridgeRobot("rover", "/cmd_vel", "/odom", host="127.0.0.1", port=suite.ask("port"),
                               cmd_vel_type=TWIST, command_gate=OPEN)  # fmt: skip
        try:
            assert robot.drive(0.5, duration=0.2)["status"] == "success"
            eventually(lambda: robot.halt("while it lives").stopped)
            suite.signal(signal.SIGSTOP)
            verdict = robot.halt("after it froze")
            assert (verdict.stopped, "did not confirm" in str(verdict.not_stopped)) == (False, True)
            suite.kill()
            assert robot.halt("after it died").stopped is False
        finally:
            robot.disconnect()


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path)


def secured(authority: Authority) -> ssl.SSLContext:
    server = authority.issue("robot")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(server.cert, server.key)
    return context


def test_server_with_tls_and_rosauth_takes_the_right_secret_alone(authority: Authority) -> None:
    server = RosbridgeSuite(secret="only we know", tls=secured(authority))
    server.start()
    pem = str(authority.issue("operator").ca)
    links = {
        secret: RosbridgeLink("127.0.0.1", server.port, connect_s=20.0, access=RosbridgeAccess(tls=pem, secret=secret))
        for secret in ("a guess", "only we know")
    }
    try:
        assert links["only we know"].url.startswith("wss://")
        links["only we know"].publish("/cmd_vel", TWIST, {"right": 1})
        eventually(lambda: server.published == [("/cmd_vel", {"right": 1})])
        refused(links["a guess"], "/cmd_vel", TWIST, "onnection")
        assert server.published == [("/cmd_vel", {"right": 1})]
    finally:
        for each in links.values():
            each.close()
        server.stop()


def test_server_of_another_authority_is_refused(authority: Authority, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = Authority(tmp_path / "other", "other-authority").issue("operator").ca
    server = RosbridgeSuite(tls=secured(authority))
    server.start()
    link = RosbridgeLink("127.0.0.1", server.port, connect_s=20.0, access=RosbridgeAccess(tls=str(other)))
    try:
        with pytest.raises(RosError, match="CERTIFICATE_VERIFY_FAILED"):
            link.publish("/cmd_vel", TWIST, {})
    finally:
        link.close()
        server.stop()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"secret": "s"}, "tls must be given"),
        ({"headers": {"Authorization": "Bearer t"}}, "tls must be given"),
        ({"tls": "/nowhere.pem"}, "tls must be a readable PEM file"),
        ({"tls": True, "headers": {"A": "b\r\nc"}}, "headers"),
    ],
)
def test_unusable_access_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        RosbridgeAccess(**options)
