"""Frames of the rosbridge v2 protocol: JSON objects with an ``op``, some in fragments, bytes as base64.

Source: ``ROSBRIDGE_PROTOCOL.md`` of rosbridge_suite. ``status`` is no longer in it, but servers still send it.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from typing import Any

from strands_robots.ros.link import RosError
from strands_robots.ros.names import bare_kind

FRAME_MAX = 16 * 2**20
"""Longest frame and longest reassembled message in bytes: a raw 1080p image in base64 fits."""

FRAGMENTS_MAX = 10_000
PARTIAL_MAX = 8
"""Fragmented messages that may be unfinished at the same time; the oldest is dropped for a newer one."""

BYTE_FIELDS = {
    "sensor_msgs/Image": "data",
    "sensor_msgs/CompressedImage": "data",
    "sensor_msgs/PointCloud2": "data",
    "std_msgs/UInt8MultiArray": "data",
}
"""Where the common messages hold ``uint8[]``, which arrives as base64."""


def encoded(op: str, **fields: Any) -> str:
    """One frame. Raises :class:`RosError` for what JSON cannot carry, NaN and infinities among it."""
    try:
        return _encoder.encode({"op": op, **fields})
    except (TypeError, ValueError, RecursionError) as exc:
        raise RosError(f"{op} cannot be sent as JSON: {exc}") from exc


def decoded(frame: str | bytes) -> dict[str, Any]:
    """The object of a frame. Raises :class:`RosError` when there is none."""
    try:
        found = json.loads(frame)
    except (ValueError, RecursionError) as exc:
        raise RosError(f"a frame is no JSON: {exc}") from exc
    if not isinstance(found, dict) or not isinstance(found.get("op"), str):
        raise RosError("a frame is no object with an op")
    return found


def with_bytes(kind: str | None, message: Mapping[str, Any]) -> dict[str, Any]:
    """The message with its ``uint8[]`` as ``bytes``, where its type is known to hold one."""
    plain = dict(message)
    field = BYTE_FIELDS.get(bare_kind(kind)) if kind else None
    if field is not None and field in plain:
        plain[field] = as_bytes(plain[field])
    return plain


def as_bytes(value: object) -> bytes:
    """``uint8[]`` of either spelling, base64 or a list of numbers. Raises :class:`RosError` for anything else."""
    try:
        if isinstance(value, str):
            return base64.b64decode(value, validate=True)
        if isinstance(value, list):
            return bytes(value)
    except (binascii.Error, ValueError, TypeError) as exc:
        raise RosError(f"a uint8[] is neither base64 nor a list of bytes: {exc}") from exc
    raise RosError("a uint8[] is neither base64 nor a list of bytes")


class Fragments:
    """Puts ``fragment`` operations together, bounded in number and size."""

    def __init__(self) -> None:
        self._partial: dict[str, dict[int, str]] = {}

    def add(self, frame: Mapping[str, Any]) -> dict[str, Any] | None:
        """The whole message once its last fragment is here, else None. Raises :class:`RosError` for nonsense."""
        key, number, total, data = (frame.get(name) for name in ("id", "num", "total", "data"))
        numbered = type(number) is int and type(total) is int and 0 <= number < total <= FRAGMENTS_MAX
        if not (isinstance(key, str) and numbered and isinstance(data, str)):
            raise RosError("a fragment lacks its id, number, total or data")
        assert isinstance(number, int)
        parts = self._partial.setdefault(key, {})
        parts[number] = data
        if len(self._partial) > PARTIAL_MAX:
            del self._partial[next(iter(self._partial))]
        if sum(map(len, parts.values())) > FRAME_MAX:
            del self._partial[key]
            raise RosError(f"the fragments of a message are longer than {FRAME_MAX} characters")
        if len(parts) != total:
            return None
        del self._partial[key]
        return decoded("".join(parts[index] for index in sorted(parts)))


def _plain(value: Any) -> Any:
    if isinstance(value, bytes | bytearray):
        return base64.b64encode(value).decode("ascii")
    listed = getattr(value, "tolist", None)
    if callable(listed):
        return listed()
    raise TypeError(f"{type(value).__name__} has no JSON form")


_encoder = json.JSONEncoder(allow_nan=False, default=_plain)
