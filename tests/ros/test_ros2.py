from __future__ import annotations

import pytest

from strands_robots.ros import ros_action
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import RosError
from strands_robots.ros.rclpy import MAX_QOS_HISTORY_DEPTH, RclpyLink
from strands_robots.ros.ros2 import Ros2Link, ros2_backend
from strands_robots.utils import ValidationError


def installed(monkeypatch: pytest.MonkeyPatch, *, rclpy: bool, cyclonedds: bool) -> None:
    monkeypatch.setattr("strands_robots.ros.ros2.sourced", lambda: rclpy)
    monkeypatch.setattr("strands_robots.ros.ros2.find_spec", lambda name: object() if cyclonedds else None)


def test_a_sourced_ros_2_is_nearer_than_bare_dds(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, rclpy=True, cyclonedds=True)
    assert isinstance(Ros2Link(3).open(), RclpyLink)
    installed(monkeypatch, rclpy=False, cyclonedds=True)
    assert isinstance(Ros2Link(3).open(), DdsLink)
    assert ros2_backend() == "dds"


def test_no_road_at_all_is_one_sentence_that_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, rclpy=False, cyclonedds=False)
    with pytest.raises(RosError, match="No way to a ROS 2 graph"):
        Ros2Link().publish("/a", "std_msgs/msg/String", {})
    answer = ros_action("status")
    assert answer["status"] == "error"
    assert "pip install -e '.[ros2]'" in answer["reason"]


def test_rclpy_asked_for_by_name_and_not_there_says_to_source_it() -> None:
    assert "source a ROS 2 installation" in ros_action("list_topics", backend="rclpy")["reason"]


def test_a_goal_over_bare_dds_says_what_carries_it(monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_a_link_that_cannot_be_is_refused(options: dict[str, object], named: str) -> None:
    with pytest.raises(ValidationError, match=f"{named} must be"):
        RclpyLink(**options)  # type: ignore[arg-type]
