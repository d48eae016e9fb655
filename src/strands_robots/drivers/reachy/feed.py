"""What the daemon last said: joints, head pose, IMU and status, each with its age.

The two eras of the daemon send the same objects, over a WebSocket with a ``type`` and over Zenoh with a key. Joint
frames are decoded as they come, because the life of the link is judged by them; the others when somebody asks.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from strands_robots.drivers.reachy.pose import HeadPose
from strands_robots.utils import ValidationError

FRESH_S = 1.5
"""Oldest sample that still counts, in seconds: joints come at 37 to 50 Hz."""

HEAD_JOINTS = ("body_yaw", "stewart_1", "stewart_2", "stewart_3", "stewart_4", "stewart_5", "stewart_6")


@dataclass(frozen=True, slots=True)
class Joints:
    """Positions in radians: body yaw, the six legs of the head, and the antennas (right, left)."""

    head: tuple[float, ...]
    antennas: tuple[float, float]
    at: float

    @property
    def body_yaw(self) -> float:
        return self.head[0]

    def named(self) -> dict[str, float]:
        """By motor name."""
        right, left = self.antennas
        return {**dict(zip(HEAD_JOINTS, self.head, strict=True)), "right_antenna": right, "left_antenna": left}


@dataclass(frozen=True, slots=True)
class Imu:
    """Accelerometer (m/s^2), gyroscope (rad/s), quaternion (w, x, y, z) and temperature (degrees Celsius)."""

    accelerometer: tuple[float, ...]
    gyroscope: tuple[float, ...]
    quaternion: tuple[float, ...]
    temperature: float
    at: float


class Feed:
    """The latest of each message of one robot. Written by the link's thread, read by any."""

    def __init__(self) -> None:
        self._raw: dict[str, tuple[str | bytes, float]] = {}
        self._joints: Joints | None = None
        self._heard = -math.inf
        self._news = threading.Condition()
        self.joint_frames = 0
        self.unusable_frames = 0

    def take(self, kind: str, payload: str | bytes) -> None:
        """Store one message; anything that is not understood is dropped, as the daemon's clients do."""
        now = time.monotonic()
        if kind != "joint_positions":
            self._raw[kind] = (payload, now)
            return
        joints = _joints(payload, now)
        with self._news:
            self._heard = now
            if joints is None:
                self.unusable_frames += 1
                return
            self._joints = joints
            self.joint_frames += 1
            self._news.notify_all()

    def clear(self) -> None:
        """Forget everything: a new link tells its own story."""
        with self._news:
            self._raw.clear()
            self._joints = None
            self._heard = -math.inf

    def wait(self, within_s: float) -> bool:
        """True as soon as a usable joint frame is there, False when ``within_s`` are over."""
        with self._news:
            return self._news.wait_for(lambda: self._joints is not None, within_s)

    @property
    def silent_s(self) -> float:
        """Seconds since any joint frame, usable or not; infinite before the first."""
        return time.monotonic() - self._heard

    @property
    def alive(self) -> bool:
        """Joint frames arrive."""
        return self.silent_s <= FRESH_S

    @property
    def joints(self) -> Joints | None:
        """The last usable joint positions, however old."""
        return self._joints

    @property
    def fresh_joints(self) -> Joints | None:
        """The last joint positions unless they are stale."""
        joints = self._joints
        return joints if joints is not None and time.monotonic() - joints.at <= FRESH_S else None

    def pose(self) -> HeadPose | None:
        """The measured head pose, or None when stale or unusable."""
        found = self._object("head_pose", FRESH_S)
        rows = found.get("head_pose") if found else None
        if not isinstance(rows, list):
            return None
        flat = [value for row in rows for value in (row if isinstance(row, list) else [row])]
        try:
            return HeadPose.from_matrix(flat)
        except (ValidationError, TypeError):
            return None

    def imu(self) -> Imu | None:
        """The last inertial sample, however old, or None on a robot without one."""
        found = self._object("imu_data", math.inf)
        if found is None:
            return None
        triples = [
            _numbers(found.get(key), n) for key, n in (("accelerometer", 3), ("gyroscope", 3), ("quaternion", 4))
        ]
        temperature = _numbers([found.get("temperature")], 1)
        if temperature is None or any(part is None for part in triples):
            return None
        accelerometer, gyroscope, quaternion = (part or () for part in triples)
        return Imu(accelerometer, gyroscope, quaternion, temperature[0], self._raw["imu_data"][1])

    def status(self) -> dict[str, Any] | None:
        """The daemon's status object when it came within three seconds (it comes every second)."""
        return self._object("daemon_status", 3.0)

    def _object(self, kind: str, within_s: float) -> dict[str, Any] | None:
        payload, at = self._raw.get(kind, ("", -math.inf))
        if time.monotonic() - at > within_s or not payload:
            return None
        try:
            found = json.loads(payload)
        except ValueError:
            return None
        return found if isinstance(found, dict) else None


Sink = Callable[[str, str | bytes], None]
"""``Feed.take``: what a link calls with each message's kind and text."""


def _joints(payload: str | bytes, at: float) -> Joints | None:
    try:
        found = json.loads(payload)
        head = _numbers(found["head_joint_positions"], 7)
        antennas = _numbers(found["antennas_joint_positions"], 2)
    except (ValueError, KeyError, TypeError):
        return None
    return Joints(head, (antennas[0], antennas[1]), at) if head and antennas else None


def _numbers(values: object, length: int) -> tuple[float, ...] | None:
    """``length`` finite numbers, or None: NaN arrives as null over WebSocket and as a bare NaN over Zenoh."""
    if not isinstance(values, list) or len(values) != length:
        return None
    good = all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values)
    return tuple(float(v) for v in values) if good else None
