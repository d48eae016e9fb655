"""A base is made with a transport as strands-robots 0.5 took it, such as a test's own double."""

from __future__ import annotations

from typing import Any
from unittest.mock import MagicMock

import pytest
from fixtures.ros_bases import OPEN

from strands_robots.drivers.ros import MobileBaseRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.transport_link import TransportLink
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.link import RosError
from strands_robots.utils import ValidationError


class Transport:
    """A double with the calls of a transport, which writes down what it sends."""

    twist_type = "geometry_msgs/Twist"

    def __init__(self, echo: Any = None, refusal: str = "") -> None:
        self.sent: list[tuple[str, str, float]] = []
        self._echo, self._refusal = echo, refusal

    def publish(self, *, topic: str, fields: dict[str, Any], count: int, rate: float, **named: Any) -> Envelope:
        assert (count, rate) == (1, 1.0)
        self.sent.append((topic, named["type"], fields["linear"]["x"]))
        return error(self._refusal) if self._refusal else success("Published.")

    def echo(self, **named: Any) -> Any:
        assert named.keys() == {"topic", "type", "count", "timeout"}
        return self._echo


@pytest.mark.parametrize("named", [False, True], ids=["in order", "by name"])
def test_base_drives_by_a_transport(named: bool) -> None:
    transport = Transport()
    options: dict[str, Any] = {"publish_rate": 1000.0, "command_gate": OPEN}
    if named:
        base = MobileBaseRobot("rover", cmd_vel_topic="/cmd_vel", transport=transport, **options)
    else:
        base = MobileBaseRobot("rover", "/cmd_vel", transport, **options)
    assert base.drive(0.5, count=2)["status"] == "success"
    kind = "geometry_msgs/Twist"
    assert transport.sent == [("/cmd_vel", kind, 0.5), ("/cmd_vel", kind, 0.5), ("/cmd_vel", kind, 0.0)]
    assert base.stop()["status"] == "success"


def test_drive_that_a_transport_refuses_is_refused() -> None:
    base = MobileBaseRobot("rover", "/cmd_vel", Transport(refusal="no bridge"), command_gate=OPEN)
    assert "no bridge" in base.drive(0.5)["reason"]


@pytest.mark.parametrize(
    "echo",
    [
        [{"x": 1.0}],
        success("One sample.", samples=[{"x": 1.0}]),
        success('echo /odom (nav_msgs/Odometry):\n[\n  {"x": 1.0}\n]'),
    ],
    ids=["a list", "a field", "text"],
)
def test_sample_of_a_transport_is_read(echo: Any) -> None:
    assert TransportLink(Transport(echo)).read("/odom", None, 1.0) == {"x": 1.0}


@pytest.mark.parametrize("echo", [None, [], success("Nothing.", samples=[]), MagicMock(), error("timed out")])
def test_transport_that_gives_no_sample_says_so(echo: Any) -> None:
    with pytest.raises(RosError, match=r"no message of /odom|timed out"):
        TransportLink(Transport(echo)).read("/odom", None, 1.0)


def test_transport_without_a_service_says_so() -> None:
    link = TransportLink(Transport())
    with pytest.raises(RosError, match="has no service_call"):
        link.call("/arm", "std_srvs/Empty", {}, 1.0)
    with pytest.raises(RosError, match="cannot be watched"):
        link.watch("/odom", None, lambda message: None)
    link.close()


def test_what_is_no_transport_is_refused() -> None:
    with pytest.raises(ValidationError, match="transport must have publish and echo"):
        MobileBaseRobot("rover", "/cmd_vel", object())
    with pytest.raises(TypeError, match="needs a link"):
        MobileBaseRobot("rover")
    with pytest.raises(TypeError, match="unexpected keyword argument 'transprot'"):
        MobileBaseRobot("rover", "/cmd_vel", transprot=Transport())


def test_mock_is_a_transport_whose_answers_prove_nothing() -> None:
    base = MobileBaseRobot("rover", "/cmd_vel", MagicMock(), command_gate=OPEN)
    for answer in (base.drive(0.5), base.stop()):
        assert "unknown result shape" in answer["reason"]


@pytest.mark.parametrize(
    ("given", "name"), [("/turtle1", "turtle1"), ("~base", "base"), ("/fleet/rover", "fleet_rover")]
)
def test_graph_name_of_a_robot_becomes_an_identifier(given: str, name: str) -> None:
    robot = RosBridgedRobot(given, "/turtle1/cmd_vel", "/turtle1/pose")
    assert (robot.node_name, robot.tool_name_str) == (name, name)
