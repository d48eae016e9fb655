"""Sensor topics: pose, IMU, odometry, health, lidar, hands, map.

A provider is a callable that returns the fields of one message, or None when there is nothing to say. A robot's own
``get_pose``, ``get_imu``, ``get_odom``, ``get_lidar_summary``, ``get_lidar_state``, ``get_hand_state`` and
``get_map_info`` are providers; others are added with :meth:`SensorLoopsMixin.add_sensor`.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context
from strands_robots.mesh.scheduler import Scheduler
from strands_robots.utils import ValidationError, identifier, shown

Provider = Callable[[], Mapping[str, Any] | None]

STARTED = time.monotonic()


@dataclass(frozen=True, slots=True)
class SensorKind:
    """One sensor: its topic suffix, the setting that holds its rate, and the robot's method that reads it."""

    suffix: str
    setting: str
    method: str


KINDS = {
    "pose": SensorKind("pose", "STRANDS_MESH_POSE_HZ", "get_pose"),
    "imu": SensorKind("imu", "STRANDS_MESH_IMU_HZ", "get_imu"),
    "odom": SensorKind("odom", "STRANDS_MESH_ODOM_HZ", "get_odom"),
    "health": SensorKind("health", "STRANDS_MESH_HEALTH_HZ", "get_health"),
    "lidar_summary": SensorKind("lidar/summary", "STRANDS_MESH_LIDAR_SUMMARY_HZ", "get_lidar_summary"),
    "lidar_state": SensorKind("lidar/state", "", "get_lidar_state"),
    "map_info": SensorKind("map/info", "STRANDS_MESH_MAP_INFO_HZ", "get_map_info"),
}


class SensorLoopsMixin:
    """The sensor half of a mesh peer, over the context, scheduler and robot of the class it is mixed into."""

    _context: Context
    _scheduler: Scheduler
    robot: Any

    def add_sensor(self, name: str, provider: Provider, hz: float | None = None) -> None:
        """Publish what ``provider`` returns.

        Args:
            name: one of :data:`KINDS`, or ``hand/NAME``.
            provider: called on the sampler thread; its keys cannot override ``peer_id`` and ``t``.
            hz: messages a second; the setting's by default, and 0 or less is off.

        Raises:
            ValidationError: another name.
        """
        suffix, default_hz = _topic(name)
        rate = default_hz if hz is None else hz
        key = topics.sensor(self._context.peer_id, suffix)
        self._scheduler.every(f"sensor:{suffix}", rate, lambda: self._sample(key, provider))

    def add_robot_sensors(self) -> list[str]:
        """Publish every sensor the robot itself can read; the suffixes."""
        body = getattr(self.robot, "wrapped", self.robot)
        found = ["health"]
        battery = getattr(body, "get_health", None)
        self.add_sensor("health", lambda: health(battery if callable(battery) else None))
        for name, kind in KINDS.items():
            read = getattr(body, kind.method, None)
            if name == "health" or not callable(read):
                continue
            self.add_sensor(name, partial(_pose_of, read) if name == "pose" else read)
            found.append(kind.suffix)
        hands = getattr(body, "get_hand_states", None)
        names = getattr(body, "hand_names", ())
        if callable(hands):
            for hand in names:
                self.add_sensor(f"hand/{hand}", partial(_one_of, hands, hand))
                found.append(f"hand/{hand}/state")
        return found

    def _sample(self, key: str, provider: Provider) -> None:
        fields = provider()
        if fields is not None:
            self._context.put(key, self._stamp_local_keys(fields))

    def _stamp_local_keys(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """``fields`` with what is decided here written last."""
        return {**fields, "peer_id": self._context.peer_id, "t": self._context.clock()}


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
        sign = -1.0 if quat[0] < 0 else 1.0
        found["quat"] = [sign * value / norm for value in quat]
    return found


def _pose_of(read: Provider) -> Mapping[str, Any] | None:
    return pose(read())


def _one_of(read: Callable[[], Mapping[str, Any]], name: str) -> Mapping[str, Any] | None:
    return read().get(name)


def health(battery: Callable[[], Mapping[str, Any] | None] | None = None) -> dict[str, Any]:
    """The host's health, and the robot's where it can tell.

    ``cpu_load`` is the one-minute load average over the number of cores, ``disk_free_gb`` in 1e9 bytes, ``mem_pct``
    what is in use, ``uptime_s`` of this process, ``temps`` in degrees Celsius by zone.
    """
    found: dict[str, Any] = {
        "battery_pct": None,
        "charging": None,
        "temps": _temperatures(),
        "cpu_load": round(os.getloadavg()[0] / (os.cpu_count() or 1), 3),
        "disk_free_gb": round(shutil.disk_usage("/").free / 1e9, 3),
        "mem_pct": _memory_in_use(),
        "uptime_s": round(time.monotonic() - STARTED, 1),
    }
    return {**found, **(dict(battery() or {}) if battery is not None else {})}


def _topic(name: str) -> tuple[str, float]:
    if name.startswith("hand/"):
        hand = identifier("hand", name.removeprefix("hand/"))
        return f"hand/{hand}/state", settings.number("STRANDS_MESH_HAND_HZ")
    kind = KINDS.get(name)
    if kind is None:
        raise ValidationError(f"name must be one of {', '.join(KINDS)} or hand/NAME, not {shown(name)}.")
    return kind.suffix, settings.number(kind.setting) if kind.setting else topics.BY_NAME[name].rate_hz


def _memory_in_use() -> float | None:
    with contextlib.suppress(OSError, ValueError, KeyError, IndexError):  # not Linux: the field stays empty
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        kib = {line.split(":")[0]: int(line.split()[1]) for line in lines if len(line.split()) > 1}
        return round(100 * (1 - kib["MemAvailable"] / kib["MemTotal"]), 1)
    return None


def _temperatures() -> dict[str, float]:
    found: dict[str, float] = {}
    for zone in sorted(Path("/sys/class/thermal").glob("thermal_zone*"))[:16]:
        with contextlib.suppress(OSError, ValueError):  # a zone without a sensor cannot be read
            name = (zone / "type").read_text(encoding="ascii").strip()
            found[name] = int((zone / "temp").read_text(encoding="ascii")) / 1000
    return found
