from __future__ import annotations

import dataclasses
import importlib.metadata
import random
import typing
from typing import Any

import numpy as np
import pytest
from cyclonedds.idl._machinery import BytesMachine
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from strands_robots.ros import link
from strands_robots.ros.dds_types import KINDS
from strands_robots.ros.link import RosError, plain

Image, JointState, Odometry, Twist = (
    KINDS["sensor_msgs/Image"],
    KINDS["sensor_msgs/JointState"],
    KINDS["nav_msgs/Odometry"],
    KINDS["geometry_msgs/Twist"],
)

STORE = get_typestore(Stores.ROS2_HUMBLE)
# turtlesim is not among the packages of rosbags; the fields are those of its Pose.msg.
TURTLE = "float32 x\nfloat32 y\nfloat32 theta\nfloat32 linear_velocity\nfloat32 angular_velocity\n"
STORE.register(get_types_from_msg(TURTLE, "turtlesim/msg/Pose"))
OLD = importlib.metadata.version("cyclonedds").startswith("0.10.")


def filled(struct: type[Any], fields: dict[str, Any]) -> Any:
    return link.filled(struct(), fields, lambda kind: KINDS[kind]())


def sample(struct: type[Any], rng: random.Random) -> Any:
    """An instance with something other than zero in every place."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return struct(**{name: some(hints[name], getattr(struct(), name), rng) for name in hints})


def some(hint: Any, zero: Any, rng: random.Random) -> Any:
    if dataclasses.is_dataclass(zero):
        return sample(type(zero), rng)
    if isinstance(zero, bytes):
        return rng.randbytes(rng.randrange(50))
    if isinstance(zero, bool):
        return True
    if isinstance(zero, int):
        return rng.randrange(1, 200)
    if isinstance(zero, float):
        return rng.randrange(-800, 800) / 8
    if isinstance(zero, str):
        return rng.choice(["", "base", "odométrie"])
    inner = typing.get_args(typing.get_args(hint)[0])[0]
    kind = (typing.get_args(inner) or (inner,))[0]
    if "int8" in typing.get_args(inner):
        return [rng.randrange(-128, 128) for _ in range(rng.randrange(4))]
    return [some(kind, kind(), rng) for _ in range(len(zero) or rng.randrange(4))]


def foreign(kind: str, message: Any) -> Any:
    """The same message in the types of rosbags."""
    names = kind.replace("/", "/msg/")
    fields = {}
    for each in dataclasses.fields(message):
        value = getattr(message, each.name)
        declared = next(d for n, d in STORE.get_msgdef(names).fields if n == each.name)
        fields[each.name] = converted(declared, value)
    return STORE.types[names](**fields)


def converted(declared: Any, value: Any) -> Any:
    node, what = declared
    if node.name == "NAME":
        return foreign(what.replace("/msg/", "/"), value)
    if node.name == "BASE":
        return value
    (inner, base), _ = what
    if inner.name == "NAME":
        return [foreign(base.replace("/msg/", "/"), each) for each in value]
    if base[0] == "string":
        return value
    return np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.array(value, dtype=base[0])


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_type_serializes_as_by_an_independent_serializer(kind: str) -> None:
    rng = random.Random(kind)
    for _ in range(5):
        message = sample(KINDS[kind], rng)
        theirs = bytes(STORE.serialize_cdr(foreign(kind, message), kind.replace("/", "/msg/")))
        ours = message.serialize()
        # The padding at the end is nobody's data.
        assert ours[: len(theirs)] == theirs
        assert ours[len(theirs) :].strip(b"\0") == b""
        assert KINDS[kind].deserialize(ours) == message


def test_a_small_image_is_packed_in_one_piece() -> None:
    first = "v0_machine" if OLD else "v1_machine"
    for machine in (getattr(Image.__idl__, first), Image.__idl__.v2_machine):
        assert isinstance(machine.members_machines["data"], BytesMachine)


@pytest.mark.skipif(OLD, reason="by uint8 this Cyclone DDS means what others call byte")
def test_no_field_is_declared_uint8() -> None:
    for kind, struct in KINDS.items():
        assert "uint8" not in str(typing.get_type_hints(struct, include_extras=True)), kind


def test_fields_are_filled_by_name_and_the_rest_is_zero() -> None:
    message = filled(Twist, {"linear": {"x": 1}})
    assert message == Twist(linear=dataclasses.replace(Twist().linear, x=1.0))
    assert plain(message)["angular"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert filled(JointState, {"name": ["a"], "position": np.array([0.5])}).position == [0.5]
    assert filled(Image, {"data": [1, 2]}).data == b"\x01\x02"


@pytest.mark.parametrize(
    ("struct", "fields", "named"),
    [
        (Twist, {"lineal": {}}, "lineal"),
        (Twist, {"linear": {"w": 1}}, "linear.w"),
        (Twist, {"linear": 3}, "linear must be an object"),
        (Twist, {"linear": {"x": "1"}}, "linear.x must be a float"),
        (Twist, {"linear": {"x": True}}, "linear.x must be a float"),
        (JointState, {"name": "abc"}, "name must be a list"),
        (JointState, {"position": [1.0, None]}, "position\\[1\\]"),
        (Odometry, {"pose": {"covariance": [0.0]}}, "pose.covariance must have 36"),
        (Image, {"data": "abc"}, "data must be bytes"),
        (Image, {"height": 1.5}, "height must be a int"),
    ],
)
def test_invalid_field_is_refused_by_its_path(struct: Any, fields: Any, named: str) -> None:
    with pytest.raises(RosError, match=named):
        filled(struct, fields)
