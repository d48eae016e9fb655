from __future__ import annotations

from array import array
from typing import Any

import numpy as np
import pytest
from fixtures import rclpy_stand_in
from fixtures.rclpy_stand_in.idl import MESSAGES
from fixtures.rclpy_stand_in.interfaces import message_class, to_idl

from strands_robots.ros import link
from strands_robots.ros.dds_types import KINDS
from strands_robots.ros.link import RosError, plain
from strands_robots.ros.rclpy import interface_class
from strands_robots.utils import ValidationError


def made(kind: str) -> Any:
    return message_class(MESSAGES[kind])()


def filled(message: Any, fields: dict[str, Any]) -> Any:
    return link.filled(message, fields, lambda kind: interface_class(kind, "msg")())


@pytest.fixture(autouse=True)
def sourced() -> Any:
    with rclpy_stand_in.installed():
        yield


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_empty_message_is_the_same_over_rclpy_and_bare_dds(kind: str) -> None:
    assert plain(made(kind)) == plain(KINDS[kind]())


FILLED: dict[str, dict[str, Any]] = {
    "geometry_msgs/Twist": {"linear": {"x": 1, "y": -2.5}, "angular": {"z": 0.5}},
    "sensor_msgs/JointState": {"name": ["a", "b"], "position": [0.5, 1], "header": {"frame_id": "f"}},
    "sensor_msgs/Image": {"height": 1, "width": 2, "encoding": "rgb8", "data": b"\x00\xff\x07"},
    "sensor_msgs/Imu": {"orientation_covariance": [float(n) for n in range(9)]},
    "sensor_msgs/BatteryState": {"present": True, "cell_voltage": [3.5, 4.0], "power_supply_status": 3},
    "tf2_msgs/TFMessage": {"transforms": [{"child_frame_id": "tip", "transform": {"translation": {"x": 0.25}}}]},
}


@pytest.mark.parametrize("kind", FILLED)
def test_filled_message_is_the_same_over_rclpy_and_bare_dds(kind: str) -> None:
    fields = FILLED[kind]
    message = filled(made(kind), fields)
    assert plain(message) == plain(link.filled(KINDS[kind](), fields, lambda inner: KINDS[inner]()))
    assert to_idl(message).serialize() == link.filled(KINDS[kind](), fields, lambda inner: KINDS[inner]()).serialize()


def test_numpy_arrays_and_lists_of_bytes_are_accepted() -> None:
    image = filled(made("sensor_msgs/Image"), {"data": [1, 2, 255]})
    assert image.data == array("B", [1, 2, 255])
    picture = filled(made("sensor_msgs/Image"), {"data": np.array([[1, 2], [3, 255]], dtype=np.uint8)})
    assert picture.data == array("B", [1, 2, 3, 255])
    scan = filled(made("sensor_msgs/LaserScan"), {"ranges": np.array([1.0, 2.0])})
    assert list(scan.ranges) == [1.0, 2.0]


@pytest.mark.parametrize(
    ("kind", "fields", "said"),
    [
        ("geometry_msgs/Twist", {"speed": 1}, "Twist has no field speed; it has linear, angular"),
        ("geometry_msgs/Twist", {"linear": 1}, "linear must be an object of fields, not 1"),
        ("geometry_msgs/Twist", {"linear": {"x": "1"}}, "linear.x must be a double, not '1'"),
        ("geometry_msgs/Twist", {"linear": {"x": True}}, "linear.x must be a double, not True"),
        ("sensor_msgs/JointState", {"name": "ab"}, "name must be a list, not 'ab'"),
        ("sensor_msgs/JointState", {"name": [1]}, r"name\[0\] must be a string, not 1"),
        ("sensor_msgs/Imu", {"orientation_covariance": [0.0]}, "orientation_covariance must have 9 items, not 1"),
        ("sensor_msgs/Image", {"height": 1.0}, "height must be a uint32, not 1.0"),
        ("sensor_msgs/Image", {"height": True}, "height must be a uint32, not True"),
        ("sensor_msgs/Image", {"height": -1}, "height must be a uint32, from 0 to 4294967295, not -1"),
        ("sensor_msgs/Image", {"data": [256]}, r"data\[0\] must be a uint8, from 0 to 255, not 256"),
        ("builtin_interfaces/Time", {"sec": 2**31}, "sec must be a int32, from -2147483648 to 2147483647"),
        ("sensor_msgs/BatteryState", {"present": 1}, "present must be a boolean, not 1"),
    ],
)
def test_invalid_value_is_refused_by_its_path(kind: str, fields: dict[str, Any], said: str) -> None:
    with pytest.raises(RosError, match=said):
        filled(made(kind), fields)


def test_an_interface_that_is_not_installed_is_named() -> None:
    assert interface_class("geometry_msgs/Twist", "msg") is interface_class("geometry_msgs/msg/Twist", "msg")
    with pytest.raises(RosError, match=r"nowhere/msg/Thing is not installed .* no module nowhere"):
        interface_class("nowhere/msg/Thing", "msg")
    with pytest.raises(RosError, match=r"geometry_msgs.msg has no Thing"):
        interface_class("geometry_msgs/Thing", "msg")
    with pytest.raises(ValidationError, match="type must be"):
        interface_class("geometry msgs", "msg")
