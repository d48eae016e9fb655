"""What a sensor's provider answers, as the fields of a message: refusals dropped, poses in the wire's own form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from strands_robots.envelope import is_error, text_of
from strands_robots.quaternions import w_positive, yaw_of
from strands_robots.utils import shown

ENVELOPE_KEYS = ("status", "content")


class NoReadingError(Exception):
    """The robot answered that it has no reading now; the message is its reason."""


def plain(answer: object) -> dict[str, Any] | None:
    """The fields of an answer, without what makes it an envelope; None where there is nothing to say.

    Raises:
        NoReadingError: the answer is an error, or no mapping.
    """
    if answer is None:
        return None
    if not isinstance(answer, Mapping):
        raise NoReadingError(f"a reading must be a mapping, not {shown(answer)}")
    fields = dict(answer)
    if is_error(fields):
        raise NoReadingError(text_of(fields) or "it says no more")
    if "content" in fields:
        # A status beside a content is the envelope's; alone it is the provider's own field.
        for key in ENVELOPE_KEYS:
            fields.pop(key, None)
    return fields or None


def pose(fields: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """A pose with its quaternion (w, x, y, z) normalised and w not negative; None where it is no rotation."""
    if fields is None:
        return None
    found = dict(fields)
    if "quat" in found:
        quat = [float(value) for value in found["quat"]]
        norm = math.sqrt(sum(value * value for value in quat))
        if len(quat) != 4 or not math.isfinite(norm) or norm == 0:
            return None
        found["quat"] = [value / norm for value in w_positive(quat)]
    return found


def pose_of(fields: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The same of a robot's answer, where that is a ROS message of its ``topic`` its pose in it."""
    if fields is not None and isinstance(fields.get("message"), Mapping):
        return pose(from_ros(fields["message"], str(fields.get("topic", "")) or None))
    return pose(fields)


def from_ros(message: Mapping[str, Any], source: str | None = None) -> dict[str, Any]:
    """The pose in a ``nav_msgs/Odometry``, a ``PoseStamped``, a ``PoseWithCovarianceStamped`` or a ``turtlesim/Pose``.

    ROS writes a quaternion as x, y, z, w (``geometry_msgs/Quaternion``); ``theta`` is its yaw in radians. A turtle
    lives in a plane, z = 0, and tells its yaw alone. ``frame`` is None where the message names none.

    Raises:
        NoReadingError: the message holds no pose.
    """
    header = message.get("header")
    frame = header.get("frame_id") if isinstance(header, Mapping) else None
    try:
        if "theta" in message:
            yaw = float(message["theta"])
            x, y, z = float(message["x"]), float(message["y"]), 0.0
            quat = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
        else:
            inner: Any = message["pose"]
            inner = inner.get("pose", inner)
            x, y, z = (float(inner["position"][axis]) for axis in "xyz")
            quat = [float(inner["orientation"][axis]) for axis in "wxyz"]
            yaw = yaw_of(quat)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise NoReadingError(f"{source or 'the message'} holds no pose") from None
    if not all(math.isfinite(value) for value in (x, y, z, yaw, *quat)):
        raise NoReadingError(f"{source or 'the message'} holds a pose that is no number")
    return {"x": x, "y": y, "z": z, "theta": yaw, "quat": quat, "source": source or "ros", "frame": frame or None}
