"""Sensor topics: pose, IMU, odometry, health, lidar, hands, map.

A provider is a callable that returns the fields of one message, or None when there is nothing to say. A robot's own
``get_pose``, ``get_imu``, ``get_odom``, ``get_lidar_summary``, ``get_lidar_state``, ``get_hand_state`` and
``get_map_info`` are providers; others are added with :meth:`SensorLoopsMixin.add_sensor`.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.contract import body_of
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context
from strands_robots.mesh.executor import Lane
from strands_robots.mesh.readings import NoReadingError, plain, pose, pose_of
from strands_robots.mesh.scheduler import Scheduler
from strands_robots.utils import ValidationError, identifier, shown

Provider = Callable[[], Mapping[str, Any] | None]

STARTED = time.monotonic()
READERS = 2
"""Threads that read at most; one more than one so that a sensor that waits holds up no other."""

WAITING = 32

logger = logging.getLogger(__name__)

__all__ = ["KINDS", "Provider", "SensorDesk", "SensorKind", "SensorLoopsMixin", "health", "pose"]


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


@dataclass(slots=True)
class _Sensor:
    """One sensor that is read. ``spoke`` once it said something; ``trouble`` is why it says nothing now."""

    suffix: str
    provider: Provider
    busy: bool = False
    spoke: bool = False
    trouble: str = ""


class SensorDesk:
    """Reads the sensors of one peer at their rates, and publishes what they say.

    A robot may take seconds to answer, so they are read on threads of the desk's own; one that is late skips its
    turns. A sensor that refuses or fails is told once for each reason, and nothing is published for it.
    """

    def __init__(self, context: Context, scheduler: Scheduler) -> None:
        self._context = context
        self._scheduler = scheduler
        self._lane = Lane(f"{context.peer_id}-sensors", READERS, WAITING)
        self._sensors: dict[str, _Sensor] = {}

    def add(self, suffix: str, provider: Provider, hz: float) -> None:
        """Read ``provider`` from now on ``hz`` times a second, in the place of what was there; 0 or less is off."""
        name, sensor = f"sensor:{suffix}", _Sensor(suffix, provider)
        if hz > 0:
            self._sensors[suffix] = sensor
        else:
            self._sensors.pop(suffix, None)
        self._scheduler.every(name, hz, lambda: self._due(sensor), quick=True)

    def topics(self) -> list[str]:
        """The suffixes on which something is published."""
        return sorted(sensor.suffix for sensor in list(self._sensors.values()) if sensor.spoke)

    def stop(self, timeout: float) -> list[str]:
        """Read no more; names of threads that still read after ``timeout`` seconds."""
        return self._lane.stop(timeout)

    def _due(self, sensor: _Sensor) -> None:
        if not sensor.busy:
            sensor.busy = True
            if not self._lane.submit(lambda: self._sample(sensor)):
                sensor.busy = False

    def _sample(self, sensor: _Sensor) -> None:
        trouble, level = "", logging.WARNING
        try:
            fields = plain(sensor.provider())
            if sensor.suffix == "pose":
                fields = pose_of(fields)
            if fields is not None:
                key = topics.sensor(self._context.peer_id, sensor.suffix)
                self._context.put(key, stamped(fields, self._context))
                sensor.spoke = True
        except NoReadingError as exc:
            trouble, level = f"{exc}", logging.INFO  # it has none, which is no fault
        except Exception as exc:  # noqa: BLE001 - whatever a provider raises costs its own turn alone
            trouble = f"{type(exc).__name__}: {exc}"
        finally:
            sensor.busy = False
        # By its words without numbers: an age in them makes no new reason.
        kind = "".join(letter for letter in trouble if not letter.isdigit())
        if kind and kind != sensor.trouble:
            logger.log(level, "%s: no %s is published: %s", self._context.peer_id, sensor.suffix, trouble)
        sensor.trouble = kind


class SensorLoopsMixin:
    """The sensor half of a mesh peer, over the context, desk and robot of the class it is mixed into."""

    _context: Context
    _sensors: SensorDesk
    robot: Any

    def add_sensor(self, name: str, provider: Provider, hz: float | None = None) -> None:
        """Publish what ``provider`` returns.

        Args:
            name: one of :data:`KINDS`, or ``hand/NAME``.
            provider: called on a thread of the sensors; its keys cannot override ``peer_id`` and ``t``. An error
                envelope and None are not published, and of a success only its fields are.
            hz: messages a second; the setting's by default, and 0 or less is off.

        Raises:
            ValidationError: another name.
        """
        suffix, default_hz = _topic(name)
        self._sensors.add(suffix, provider, default_hz if hz is None else hz)

    def add_robot_sensors(self) -> None:
        """Publish every sensor the robot itself can read, and the health of its host."""
        body = body_of(self.robot)
        own = getattr(body, "get_health", None)
        self.add_sensor("health", partial(health, _Contained(own, self._context.peer_id) if callable(own) else None))
        for name, kind in KINDS.items():
            read = getattr(body, kind.method, None)
            if name != "health" and callable(read):
                self.add_sensor(name, read)
        hands = getattr(body, "get_hand_states", None)
        if callable(hands):
            for hand in getattr(body, "hand_names", ()):
                self.add_sensor(f"hand/{hand}", partial(_one_of, hands, hand))

    def _stamp_local_keys(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """``fields`` with what is decided here written last."""
        return stamped(fields, self._context)


class _Contained:
    """A robot's own health; where it cannot tell, that is logged once and the host's is told all the same."""

    def __init__(self, read: Provider, peer_id: str) -> None:
        self._read = read
        self._peer_id = peer_id
        self._trouble = ""

    def __call__(self) -> Mapping[str, Any] | None:
        try:
            found, trouble = plain(self._read()), ""
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is told
            found, trouble = None, f"{type(exc).__name__}: {exc}"
        if trouble and trouble != self._trouble:
            logger.info("%s: the health of its robot cannot be read: %s", self._peer_id, trouble)
        self._trouble = trouble
        return found


def stamped(fields: Mapping[str, Any], context: Context) -> dict[str, Any]:
    """``fields`` with the peer and the time written last, so that a provider cannot speak for another."""
    return {**fields, "peer_id": context.peer_id, "t": context.clock()}


def _one_of(read: Callable[[], Mapping[str, Any]], name: str) -> Mapping[str, Any] | None:
    hands = plain(read())
    return None if hands is None else hands.get(name)


def health(own: Callable[[], Mapping[str, Any] | None] | None = None) -> dict[str, Any]:
    """The host's health, and the robot's where it can tell.

    ``cpu_load`` is the one-minute load average over the number of cores, ``disk_free_gb`` in 1e9 bytes, ``mem_pct``
    what is in use, ``uptime_s`` of this process, ``temps`` in degrees Celsius by zone
    of the host and by motor.
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
    told = (plain(own()) if own is not None else None) or {}
    heat = told.get("temps")
    return {**found, **told, "temps": {**found["temps"], **(heat if isinstance(heat, Mapping) else {})}}


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
