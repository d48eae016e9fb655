"""Encoding of joint states, JPEG pictures and log lines for Foxglove and Rerun.

Sources: ``sensor_msgs/msg/JointState`` in CDR (OMG XTypes 1.3, plain CDR, little endian) with its definition as text;
``foxglove.CompressedImage`` and ``foxglove.Log`` as protobuf, field numbers from docs.foxglove.dev; a protobuf schema
in MCAP is a ``FileDescriptorSet`` (``google/protobuf/descriptor.proto``). Each has few fields, so they are encoded
here without a protobuf runtime.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from strands_robots.utils import ValidationError

JOINT_STATE_TEXT = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

INFO, WARNING, ERROR = 2, 3, 4
"""Levels of ``foxglove.Log``."""

JOINTS_MAX = 10_000
"""Most joints of one message."""

_NS = 1_000_000_000
_CDR_LITTLE_ENDIAN = b"\0\1\0\0"
_VARINT, _LENGTH = 0, 2

_STRING, _BYTES, _MESSAGE, _ENUM, _FIXED32 = 9, 12, 11, 14, 7
_INT64, _INT32 = 3, 5
_TIMESTAMP = ".google.protobuf.Timestamp"


@dataclass(frozen=True, slots=True)
class Schema:
    """One schema of an MCAP file, with the encoding of its messages."""

    name: str
    encoding: str
    data: bytes
    messages: str


def joint_state(at_ns: int, joints: Mapping[str, float]) -> bytes:
    """Encode a ``sensor_msgs/msg/JointState`` of names and positions."""
    out = bytearray(struct.pack("<iI", at_ns // _NS, at_ns % _NS))
    _text(out, "")
    _count(out, len(joints))
    for name in joints:
        _text(out, name)
    _count(out, len(joints))
    if joints:
        _pad(out, 8)
        out += struct.pack(f"<{len(joints)}d", *joints.values())
    # No velocities, no efforts.
    return _CDR_LITTLE_ENDIAN + bytes(out) + struct.pack("<II", 0, 0)


def read_joint_state(data: bytes) -> dict[str, float]:
    """Decode a message of :func:`joint_state`.

    Raises:
        struct.error: it is another message.
        ValidationError: it has more than JOINTS_MAX joints.
    """
    body, at = data[len(_CDR_LITTLE_ENDIAN) :], 8

    def length(here: int) -> tuple[int, int]:
        here += -here % 4
        (value,) = struct.unpack_from("<I", body, here)
        return value, here + 4

    size, at = length(at)
    count, at = length(at + size)
    if count > JOINTS_MAX:
        raise ValidationError(f"a joint state has {count:,} joints, and may have {JOINTS_MAX:,}")
    names = []
    for _ in range(count):
        size, at = length(at)
        names.append(body[at : at + size - 1].decode("utf-8", "replace"))
        at += size
    count, at = length(at)
    at += -at % 8 if count else 0
    return dict(zip(names, struct.unpack_from(f"<{count}d", body, at), strict=False))


def compressed_image(at_ns: int, camera: str, jpeg: bytes) -> bytes:
    """Encode a ``foxglove.CompressedImage``: time 1, data 2, format 3, frame_id 4."""
    return _time(at_ns) + _field(2, jpeg) + _field(3, b"jpeg") + _field(4, camera.encode())


def read_compressed_image(data: bytes) -> bytes:
    """Return the JPEG of a message of :func:`compressed_image`, empty for none."""
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        if key & 7 != _LENGTH:
            return b""
        size, at = _read_varint(data, at)
        if key >> 3 == 2:
            return data[at : at + size]
        at += size
    return b""


def log_line(at_ns: int, level: int, name: str, message: str) -> bytes:
    """Encode a ``foxglove.Log``: timestamp 1, level 2, message 3, name 4."""
    return _time(at_ns) + _number(2, level) + _field(3, message.encode()) + _field(4, name.encode())


def _pad(out: bytearray, to: int) -> None:
    out += b"\0" * (-len(out) % to)


def _count(out: bytearray, count: int) -> None:
    _pad(out, 4)
    out += struct.pack("<I", count)


def _text(out: bytearray, text: str) -> None:
    encoded = text.encode() + b"\0"
    _count(out, len(encoded))
    out += encoded


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    # A longer number would be computed anew, in full, with each of its bytes.
    while at < len(data) and shift < 64:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            break
    return value, at


def _field(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | _LENGTH) + _varint(len(data)) + data


def _number(number: int, value: int) -> bytes:
    return _varint(number << 3 | _VARINT) + _varint(value)


def _time(at_ns: int) -> bytes:
    return _field(1, _number(1, at_ns // _NS) + _number(2, at_ns % _NS))


def _descriptor(number: int, name: str, kind: int, of: str = "") -> bytes:
    """Encode a field: name 1, number 3, label 4 (optional), type 5, type_name 6."""
    field = _field(1, name.encode()) + _number(3, number) + _number(4, 1) + _number(5, kind)
    return _field(2, field + (_field(6, of.encode()) if of else b""))


def _file(path: str, package: str, message: bytes, needs: str = "") -> bytes:
    """Encode a file: name 1, package 2, dependency 3, message_type 4, syntax 12."""
    file = _field(1, path.encode()) + _field(2, package.encode())
    file += _field(3, needs.encode()) if needs else b""
    return _field(1, file + _field(4, message) + _field(12, b"proto3"))


def _set(name: str, fields: bytes) -> bytes:
    time = _field(1, b"Timestamp") + _descriptor(1, "seconds", _INT64) + _descriptor(2, "nanos", _INT32)
    needs = "google/protobuf/timestamp.proto"
    message = _field(1, name.encode()) + fields
    return _file(needs, "google.protobuf", time) + _file(f"foxglove/{name}.proto", "foxglove", message, needs)


def _levels() -> bytes:
    """Encode the enumeration of ``foxglove.Log``: name 1, value 2."""
    names = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
    values = b"".join(_field(2, _field(1, name.encode()) + _number(2, number)) for number, name in enumerate(names))
    return _field(4, _field(1, b"Level") + values)


JOINT_STATE = Schema("sensor_msgs/msg/JointState", "ros2msg", JOINT_STATE_TEXT.encode(), "cdr")

IMAGE = Schema(
    "foxglove.CompressedImage",
    "protobuf",
    _set(
        "CompressedImage",
        _descriptor(1, "timestamp", _MESSAGE, _TIMESTAMP)
        + _descriptor(2, "data", _BYTES)
        + _descriptor(3, "format", _STRING)
        + _descriptor(4, "frame_id", _STRING),
    ),
    "protobuf",
)

LOG = Schema(
    "foxglove.Log",
    "protobuf",
    _set(
        "Log",
        _descriptor(1, "timestamp", _MESSAGE, _TIMESTAMP)
        + _descriptor(2, "level", _ENUM, ".foxglove.Log.Level")
        + _descriptor(3, "message", _STRING)
        + _descriptor(4, "name", _STRING)
        + _descriptor(5, "file", _STRING)
        + _descriptor(6, "line", _FIXED32)
        + _levels(),
    ),
    "protobuf",
)

EVENT = Schema("event", "jsonschema", b'{"type": "object", "title": "event"}', "json")
