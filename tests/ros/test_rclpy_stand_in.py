"""The stand-in does not pose as more than it is."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from fixtures import rclpy_stand_in
from fixtures.rclpy_stand_in import idl
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from strands_robots.ros.dds_types import KINDS
from strands_robots.ros.rclpy import sourced

Header, PoseStamped, Time = (
    KINDS["std_msgs/Header"],
    KINDS["geometry_msgs/PoseStamped"],
    KINDS["builtin_interfaces/Time"],
)


def test_stand_in_is_importable_only_inside_its_block() -> None:
    assert not sourced()
    with rclpy_stand_in.installed():
        assert sourced()
        assert find_spec("geometry_msgs.msg") is not None
        assert import_module("nav2_msgs.action").NavigateToPose.Goal().pose.pose.orientation.w == 1.0
    assert not sourced()
    assert "nav2_msgs.action" not in sys.modules


def test_missing_parts_of_the_stand_in_raise() -> None:
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


def test_messages_of_the_stand_in_refuse_what_rosidl_refuses() -> None:
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


STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(
    get_types_from_msg(
        "uint64 guid\nint64 seq\nunique_identifier_msgs/UUID goal_id\ngeometry_msgs/PoseStamped pose\nstring tree",
        "wire/msg/SendGoal",
    )
)


def same(ours: Any, theirs: Any, kind: str) -> bool:
    """Both are the same on the wire, but for the padding at the end, which is nobody's data."""
    mine, other = ours.serialize(), bytes(STORE.serialize_cdr(theirs, kind))
    return mine[: len(other)] == other and not mine[len(other) :].strip(b"\0")


def test_wire_structures_of_the_stand_in_match_an_independent_serializer() -> None:
    types, some = STORE.types, list(range(16))
    uuid = types["unique_identifier_msgs/msg/UUID"](uuid=np.array(some, np.uint8))
    stamp = types["builtin_interfaces/msg/Time"](sec=5, nanosec=6)
    theirs = types["action_msgs/msg/GoalInfo"](goal_id=uuid, stamp=stamp)
    assert same(
        idl.GoalInfo(goal_id=idl.UUID(uuid=some), stamp=Time(sec=5, nanosec=6)), theirs, "action_msgs/msg/GoalInfo"
    )

    node = types["rmw_dds_common/msg/NodeEntitiesInfo"](
        node_namespace="/", node_name="rover", reader_gid_seq=[], writer_gid_seq=[]
    )
    gid = types["rmw_dds_common/msg/Gid"](data=np.array(some, np.uint8))
    kind = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    info = idl.NodeEntitiesInfo(node_namespace="/", node_name="rover", reader_gid_seq=[], writer_gid_seq=[])
    ours = idl.ParticipantEntitiesInfo(gid=idl.Gid(data=some), node_entities_info_seq=[info])
    assert same(ours, types[kind](gid=gid, node_entities_info_seq=[node]), kind)


def test_a_request_carries_the_header_of_rmw_cyclonedds_and_then_its_body() -> None:
    types = STORE.types
    body = idl.action_services("nav2_msgs/NavigateToPose")["send_goal"][0]
    goal = idl.ACTIONS["nav2_msgs/NavigateToPose"][0](
        pose=PoseStamped(header=Header(frame_id="map")), behavior_tree="t"
    )
    ours = idl.wrapped(idl.RequestHeader(guid=2**40, seq=7), body(goal_id=idl.UUID(uuid=[1] * 16), goal=goal))
    assert type(ours).__idl__.idl_transformed_typename == "nav2_msgs::action::dds_::NavigateToPose_SendGoal_Request_"
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="map")
    turned = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    place = types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/PoseStamped"](
        header=header, pose=types["geometry_msgs/msg/Pose"](position=place, orientation=turned)
    )
    theirs = types["wire/msg/SendGoal"](
        guid=2**40,
        seq=7,
        goal_id=types["unique_identifier_msgs/msg/UUID"](uuid=np.array([1] * 16, np.uint8)),
        pose=pose,
        tree="t",
    )
    assert same(ours, theirs, "wire/msg/SendGoal")
