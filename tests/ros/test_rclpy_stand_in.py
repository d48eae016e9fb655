"""The stand-in does not pose as more than it is."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec

import pytest

from fixtures import rclpy_stand_in
from strands_robots.ros.rclpy_session import sourced


def test_it_is_there_only_inside_its_block() -> None:
    assert not sourced()
    with rclpy_stand_in.installed():
        assert sourced()
        assert find_spec("geometry_msgs.msg") is not None
        assert import_module("nav2_msgs.action").NavigateToPose.Goal().pose.pose.orientation.w == 1.0
    assert not sourced()
    assert "nav2_msgs.action" not in sys.modules


def test_what_it_does_not_have_raises() -> None:
    with rclpy_stand_in.installed():
        rclpy, contexts = import_module("rclpy"), import_module("rclpy.context")
        with pytest.raises(NotImplementedError):
            rclpy.init()
        with pytest.raises(NotImplementedError):
            rclpy.create_node("a", context=contexts.Context())
        with pytest.raises(AttributeError):
            rclpy.create_timer  # noqa: B018 - that it is not there is the point
        with pytest.raises(RuntimeError):
            rclpy.shutdown(context=contexts.Context())


def test_its_messages_refuse_what_rosidl_refuses() -> None:
    with rclpy_stand_in.installed():
        twist = import_module("geometry_msgs.msg").Twist()
        with pytest.raises(AssertionError):
            twist.linear.x = 1
        with pytest.raises(AssertionError):
            twist.linear = {"x": 1.0}
        with pytest.raises(AttributeError):
            twist.speed = 1.0
        image = import_module("sensor_msgs.msg").Image()
        with pytest.raises(AssertionError):
            image.height = -1
