"""ROS 2 messages as IDL types of Cyclone DDS, with their names on the wire.

Fields and their order are those of the public ``.msg`` files of common_interfaces and geometry2. A ROS ``uint8``
is declared ``byte``: with ``uint8`` a peer on Cyclone DDS 0.10, which many ROS 2 installations ship, fails to match
and can crash. Annotations are evaluated by the library, so this module does not postpone them.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int8, int32, sequence, uint32

from strands_robots.ros._compat import bound_samples, pack_as_bytes

try:
    from cyclonedds.idl.types import byte
except ImportError:  # Cyclone DDS 0.10 means by uint8 what 11 means by byte
    from cyclonedds.idl.types import uint8 as byte

SAMPLE_MAX = 16 * 2**10
"""Longest sample that is decoded, in bytes: 200 transforms, or 300 joints."""

TEXT_MAX = 2**20
"""The same of a text, such as a robot's description."""

ARRAY_MAX = 256 * 2**10
"""The same of scans and maps, whose numbers are decoded at once: 65,000 ranges, or 500 by 500 cells."""

PICTURE_MAX = 3 * 2**20
"""The same of pictures, whose bytes are copied thrice: a raw one of 1280 by 720 fits."""

KINDS: dict[str, type[Any]] = {}
"""The IDL type of each ``pkg/Name`` that this bundle carries."""


def _typed(kind: str) -> dict[str, str]:
    package, _, name = kind.partition("/")
    return {"typename": f"{package}::msg::dds_::{name}_"}


def _nine() -> list[float]:
    return [0.0] * 9


def _thirty_six() -> list[float]:
    return [0.0] * 36


# The library's own spellings of lists are values, which a type checker cannot read.
if TYPE_CHECKING:
    Strings = list[str]
    Float32s = list[float]
    Int8s = list[int]
    Float64s = list[float]
    Nine = list[float]
    ThirtySix = list[float]
    Bytes = bytes
else:
    Strings = sequence[str]
    Float32s = sequence[float32]
    Int8s = sequence[int8]
    Float64s = sequence[float64]
    Bytes = sequence[byte]
    Nine = array[float64, 9]
    ThirtySix = array[float64, 36]


@dataclass
class Time(IdlStruct, **_typed("builtin_interfaces/Time")):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, **_typed("std_msgs/Header")):
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class String(IdlStruct, **_typed("std_msgs/String")):
    data: str = ""


@dataclass
class Vector3(IdlStruct, **_typed("geometry_msgs/Vector3")):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point(IdlStruct, **_typed("geometry_msgs/Point")):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, **_typed("geometry_msgs/Quaternion")):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Twist(IdlStruct, **_typed("geometry_msgs/Twist")):
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(IdlStruct, **_typed("geometry_msgs/TwistStamped")):
    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class TwistWithCovariance(IdlStruct, **_typed("geometry_msgs/TwistWithCovariance")):
    twist: Twist = field(default_factory=Twist)
    covariance: ThirtySix = field(default_factory=_thirty_six)


@dataclass
class Pose(IdlStruct, **_typed("geometry_msgs/Pose")):
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(IdlStruct, **_typed("geometry_msgs/PoseStamped")):
    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
class PoseWithCovariance(IdlStruct, **_typed("geometry_msgs/PoseWithCovariance")):
    pose: Pose = field(default_factory=Pose)
    covariance: ThirtySix = field(default_factory=_thirty_six)


@dataclass
class Transform(IdlStruct, **_typed("geometry_msgs/Transform")):
    translation: Vector3 = field(default_factory=Vector3)
    rotation: Quaternion = field(default_factory=Quaternion)


@dataclass
class TransformStamped(IdlStruct, **_typed("geometry_msgs/TransformStamped")):
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    transform: Transform = field(default_factory=Transform)


if TYPE_CHECKING:
    Transforms = list[TransformStamped]
else:
    Transforms = sequence[TransformStamped]


@dataclass
class TFMessage(IdlStruct, **_typed("tf2_msgs/TFMessage")):
    transforms: Transforms = field(default_factory=list)


@dataclass
class Odometry(IdlStruct, **_typed("nav_msgs/Odometry")):
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
class MapMetaData(IdlStruct, **_typed("nav_msgs/MapMetaData")):
    map_load_time: Time = field(default_factory=Time)
    resolution: float32 = 0.0
    width: uint32 = 0
    height: uint32 = 0
    origin: Pose = field(default_factory=Pose)


@dataclass
class OccupancyGrid(IdlStruct, **_typed("nav_msgs/OccupancyGrid")):
    header: Header = field(default_factory=Header)
    info: MapMetaData = field(default_factory=MapMetaData)
    data: Int8s = field(default_factory=list)


@dataclass
class TurtlePose(IdlStruct, **_typed("turtlesim/Pose")):
    x: float32 = 0.0
    y: float32 = 0.0
    theta: float32 = 0.0
    linear_velocity: float32 = 0.0
    angular_velocity: float32 = 0.0


@dataclass
class JointState(IdlStruct, **_typed("sensor_msgs/JointState")):
    header: Header = field(default_factory=Header)
    name: Strings = field(default_factory=list)
    position: Float64s = field(default_factory=list)
    velocity: Float64s = field(default_factory=list)
    effort: Float64s = field(default_factory=list)


@dataclass
class LaserScan(IdlStruct, **_typed("sensor_msgs/LaserScan")):
    header: Header = field(default_factory=Header)
    angle_min: float32 = 0.0
    angle_max: float32 = 0.0
    angle_increment: float32 = 0.0
    time_increment: float32 = 0.0
    scan_time: float32 = 0.0
    range_min: float32 = 0.0
    range_max: float32 = 0.0
    ranges: Float32s = field(default_factory=list)
    intensities: Float32s = field(default_factory=list)


@dataclass
class Image(IdlStruct, **_typed("sensor_msgs/Image")):
    header: Header = field(default_factory=Header)
    height: uint32 = 0
    width: uint32 = 0
    encoding: str = ""
    is_bigendian: byte = 0
    step: uint32 = 0
    data: Bytes = field(default_factory=bytes)


@dataclass
class CompressedImage(IdlStruct, **_typed("sensor_msgs/CompressedImage")):
    header: Header = field(default_factory=Header)
    format: str = ""
    data: Bytes = field(default_factory=bytes)


@dataclass
class ImuMessage(IdlStruct, **_typed("sensor_msgs/Imu")):
    header: Header = field(default_factory=Header)
    orientation: Quaternion = field(default_factory=Quaternion)
    orientation_covariance: Nine = field(default_factory=_nine)
    angular_velocity: Vector3 = field(default_factory=Vector3)
    angular_velocity_covariance: Nine = field(default_factory=_nine)
    linear_acceleration: Vector3 = field(default_factory=Vector3)
    linear_acceleration_covariance: Nine = field(default_factory=_nine)


@dataclass
class BatteryState(IdlStruct, **_typed("sensor_msgs/BatteryState")):
    header: Header = field(default_factory=Header)
    voltage: float32 = 0.0
    temperature: float32 = 0.0
    current: float32 = 0.0
    charge: float32 = 0.0
    capacity: float32 = 0.0
    design_capacity: float32 = 0.0
    percentage: float32 = 0.0
    power_supply_status: byte = 0
    power_supply_health: byte = 0
    power_supply_technology: byte = 0
    present: bool = False
    cell_voltage: Float32s = field(default_factory=list)
    cell_temperature: Float32s = field(default_factory=list)
    location: str = ""
    serial_number: str = ""


pack_as_bytes(Image, "data")
pack_as_bytes(CompressedImage, "data")

_LONGEST = {
    Image: PICTURE_MAX,
    CompressedImage: PICTURE_MAX,
    LaserScan: ARRAY_MAX,
    OccupancyGrid: ARRAY_MAX,
    String: TEXT_MAX,
}

for _struct in IdlStruct.__subclasses__():
    if _struct.__module__ == __name__:
        _package, _, _, _name = _struct.__idl_typename__.split("::")
        KINDS[f"{_package}/{_name.removesuffix('_')}"] = _struct
        bound_samples(_struct, _LONGEST.get(_struct, SAMPLE_MAX))
