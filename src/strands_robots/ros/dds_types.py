"""ROS 2 messages as IDL types of Cyclone DDS, with their names on the wire.

A ROS ``uint8`` is declared ``byte``: with ``uint8`` a peer on Cyclone DDS 0.10, which many ROS 2 installations ship,
fails to match and can crash.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, get_args

from cyclonedds.idl import make_idl_struct, types

from strands_robots.ros._compat import bound_samples, pack_as_bytes

SAMPLE_MAX = 16 * 2**10
"""Longest sample that is decoded, in bytes: 200 transforms, or 300 joints."""

TEXT_MAX = 2**20
"""The same of a text, such as a robot's description."""

ARRAY_MAX = 256 * 2**10
"""The same of scans and maps, whose numbers are decoded at once: 65,000 ranges, or 500 by 500 cells."""

PICTURE_MAX = 3 * 2**20
"""The same of pictures, whose bytes are copied thrice: a raw one of 1280 by 720 fits."""

_LONGEST = {
    "sensor_msgs/Image": PICTURE_MAX,
    "sensor_msgs/CompressedImage": PICTURE_MAX,
    "sensor_msgs/LaserScan": ARRAY_MAX,
    "nav_msgs/OccupancyGrid": ARRAY_MAX,
    "std_msgs/String": TEXT_MAX,
}

DEFINITIONS = """
builtin_interfaces/Time: int32 sec, uint32 nanosec
std_msgs/Header: builtin_interfaces/Time stamp, string frame_id
std_msgs/String: string data
geometry_msgs/Vector3: float64 x, float64 y, float64 z
geometry_msgs/Point: float64 x, float64 y, float64 z
geometry_msgs/Quaternion: float64 x, float64 y, float64 z, float64 w 1
geometry_msgs/Twist: geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular
geometry_msgs/TwistStamped: std_msgs/Header header, geometry_msgs/Twist twist
geometry_msgs/TwistWithCovariance: geometry_msgs/Twist twist, float64[36] covariance
geometry_msgs/Pose: geometry_msgs/Point position, geometry_msgs/Quaternion orientation
geometry_msgs/PoseStamped: std_msgs/Header header, geometry_msgs/Pose pose
geometry_msgs/PoseWithCovariance: geometry_msgs/Pose pose, float64[36] covariance
geometry_msgs/Transform: geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation
geometry_msgs/TransformStamped: std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform
tf2_msgs/TFMessage: geometry_msgs/TransformStamped[] transforms
nav_msgs/Odometry: std_msgs/Header header, string child_frame_id,
    geometry_msgs/PoseWithCovariance pose, geometry_msgs/TwistWithCovariance twist
nav_msgs/MapMetaData: builtin_interfaces/Time map_load_time, float32 resolution, uint32 width, uint32 height,
    geometry_msgs/Pose origin
nav_msgs/OccupancyGrid: std_msgs/Header header, nav_msgs/MapMetaData info, int8[] data
turtlesim/Pose: float32 x, float32 y, float32 theta, float32 linear_velocity, float32 angular_velocity
sensor_msgs/JointState: std_msgs/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort
sensor_msgs/LaserScan: std_msgs/Header header, float32 angle_min, float32 angle_max, float32 angle_increment,
    float32 time_increment, float32 scan_time, float32 range_min, float32 range_max, float32[] ranges,
    float32[] intensities
sensor_msgs/Image: std_msgs/Header header, uint32 height, uint32 width, string encoding, uint8 is_bigendian,
    uint32 step, uint8[] data
sensor_msgs/CompressedImage: std_msgs/Header header, string format, uint8[] data
sensor_msgs/Imu: std_msgs/Header header,
    geometry_msgs/Quaternion orientation, float64[9] orientation_covariance,
    geometry_msgs/Vector3 angular_velocity, float64[9] angular_velocity_covariance,
    geometry_msgs/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance
sensor_msgs/BatteryState: std_msgs/Header header, float32 voltage, float32 temperature, float32 current,
    float32 charge, float32 capacity, float32 design_capacity, float32 percentage, uint8 power_supply_status,
    uint8 power_supply_health, uint8 power_supply_technology, bool present, float32[] cell_voltage,
    float32[] cell_temperature, string location, string serial_number
"""
"""Types that bare DDS carries: name, and each field as in the public ``.msg`` files, a default behind its name."""

_idl: Any = types
# Cyclone DDS 0.10 means by uint8 what 11 means by byte.
_IDL_NAMES = {"bool": bool, "string": str, "uint8": getattr(_idl, "byte", _idl.uint8)}

KINDS: dict[str, type[Any]] = {}
"""The IDL type of each ``pkg/Name`` of :data:`DEFINITIONS`."""


def _field(kind: str, default: str) -> tuple[Any, Any, str]:
    """Return a field's IDL type, its dataclass default, and its type in words."""
    item, several, length = kind.removesuffix("]").partition("[")
    if item in KINDS:
        idl, word, zero = KINDS[item], item, field(default_factory=KINDS[item])
    else:
        idl = _IDL_NAMES.get(item) or getattr(_idl, item)
        # A number's type is Annotated[float, "float64"]; those of text and truth are themselves.
        plain = (get_args(idl) or (idl,))[0]
        word, zero = plain.__name__, plain(default) if default else plain()
    if length:
        zeros = [zero] * int(length)
        return _idl.array[idl, len(zeros)], field(default_factory=zeros.copy), f"{word}[{length}]"
    if several and item == "uint8":
        return _idl.sequence[idl], b"", "bytes"
    if several:
        return _idl.sequence[idl], field(default_factory=list), f"sequence<{word}>"
    return idl, zero, word


def _struct(kind: str, declared: list[list[str]]) -> type[Any]:
    """Return a message's IDL type; each field has a type, a name, maybe a default."""
    package, _, name = kind.partition("/")
    fields = {called: _field(of, "".join(default)) for of, called, *default in declared}
    idl_types = {called: idl for called, (idl, _, _) in fields.items()}
    struct: Any = make_idl_struct(name, f"{package}::msg::dds_::{name}_", idl_types, dataclassify=False)
    for called, (_, default, _) in fields.items():
        setattr(struct, called, default)
    struct = dataclass(struct)
    words = {called: word for called, (_, _, word) in fields.items()}
    struct.get_fields_and_field_types = staticmethod(lambda: words)
    pictures = [called for called, word in words.items() if word == "bytes"]
    if pictures:
        pack_as_bytes(struct, *pictures)
    bound_samples(struct, _LONGEST.get(kind, SAMPLE_MAX))
    return struct  # type: ignore[no-any-return]


for _line in DEFINITIONS.replace(",\n", ",").strip().splitlines():
    _kind, _, _fields = _line.partition(": ")
    KINDS[_kind] = _struct(_kind, [each.split() for each in _fields.split(",")])
