from __future__ import annotations

import pytest

from strands_robots.ros import ros_action
from strands_robots.ros.actions import Ros2Link, ros2_backend
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import RosError
from strands_robots.ros.rclpy import MAX_QOS_HISTORY_DEPTH, RclpyLink
from strands_robots.utils import ValidationError


def installed(monkeypatch: pytest.MonkeyPatch, *, rclpy: bool, cyclonedds: bool) -> None:
    monkeypatch.setattr("strands_robots.ros.actions.sourced", lambda: rclpy)
    monkeypatch.setattr("strands_robots.ros.actions.find_spec", lambda name: object() if cyclonedds else None)


def test_sourced_ros_2_is_preferred_to_bare_dds(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, rclpy=True, cyclonedds=True)
    assert isinstance(Ros2Link(3).open(), RclpyLink)
    installed(monkeypatch, rclpy=False, cyclonedds=True)
    assert isinstance(Ros2Link(3).open(), DdsLink)
    assert ros2_backend() == "dds"


def test_missing_backends_are_an_error_that_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, rclpy=False, cyclonedds=False)
    with pytest.raises(RosError, match="No way to a ROS 2 graph"):
        Ros2Link().publish("/a", "std_msgs/msg/String", {})
    answer = ros_action("status")
    assert answer["status"] == "error"
    assert "pip install -e '.[ros2]'" in answer["reason"]


def test_rclpy_by_name_without_a_ros_2_says_to_source_one() -> None:
    assert "source a ROS 2 installation" in ros_action("list_topics", backend="rclpy")["reason"]


def test_goal_over_bare_dds_is_refused_with_the_backends_that_carry_it(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, rclpy=False, cyclonedds=True)
    with pytest.raises(RosError, match="bare DDS carries topics only"):
        Ros2Link(3).send_goal("/go", "nav2_msgs/action/NavigateToPose", {}, 1.0)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"domain_id": -1}, "domain_id"),
        ({"domain_id": 233}, "domain_id"),
        ({"name": "1st"}, "name"),
        ({"name": "a b"}, "name"),
        ({"depth": 0}, "depth"),
        ({"depth": MAX_QOS_HISTORY_DEPTH + 1}, "depth"),
        ({"match_s": -1}, "match_s"),
    ],
)
def test_invalid_link_argument_is_refused_by_name(options: dict[str, object], named: str) -> None:
    with pytest.raises(ValidationError, match=f"{named} must be"):
        RclpyLink(**options)  # type: ignore[arg-type]
