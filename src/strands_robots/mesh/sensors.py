"""Sensor topics (pose, IMU, odometry, health, lidar, hands, map) and cameras.

A provider is a callable that returns the fields of one message, or None when it has none. A robot's own
``get_pose``, ``get_imu``, ``get_odom``, ``get_lidar_summary``, ``get_lidar_state``, ``get_hand_state`` and
``get_map_info`` are providers; others are added with :meth:`SensorLoopsMixin.add_sensor`. Refusals are dropped, and a
pose is brought into the form of the wire.
"""

from __future__ import annotations

import base64
import contextlib
import logging
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.contract import body_of
from strands_robots.envelope import is_error, text_of
from strands_robots.errors import StrandsRobotsError
from strands_robots.mesh import topics
from strands_robots.mesh.scheduler import Scheduler, TroubleLog
from strands_robots.mesh.session import Context
from strands_robots.recording.cameras import Frames, jpeg
from strands_robots.utils import ValidationError, identifier, shown, w_positive, yaw_of

logger = logging.getLogger(__name__)

Provider = Callable[[], Mapping[str, Any] | None]

STARTED = time.monotonic()
HOST_FRESH_S = 0.5
CAMERA_SPACING_S = 1.5 / (topics.BY_NAME["camera"].ceiling_hz or math.inf)
"""Between the frames of two cameras: the transport drops what comes closer on any of them."""


class NoReadingError(StrandsRobotsError):
    """The robot answered that it has no reading now; the message is its reason."""


@dataclass(frozen=True, slots=True)
class SensorKind:
    """One sensor: topic suffix, setting of its rate, and the robot's method."""

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
    """One sensor that is read; ``published`` once it had a reading."""

    suffix: str
    provider: Provider
    published: bool = False


class SensorPublisher:
    """Reads the sensors of one peer at their rates and publishes the readings.

    A robot may take seconds to answer, so a sensor that is late skips its turns and delays no other. One that refuses
    or fails is logged once for each reason, and nothing is published for it.
    """

    def __init__(self, context: Context, scheduler: Scheduler) -> None:
        self._context = context
        self._scheduler = scheduler
        self._sensors: dict[str, _Sensor] = {}
        self._troubles = TroubleLog(logger)

    def add(self, suffix: str, provider: Provider, hz: float) -> None:
        """Read ``provider`` ``hz`` times a second from now on; 0 or less is off."""
        name, sensor = f"sensor:{suffix}", _Sensor(suffix, provider)
        if hz > 0:
            self._sensors[suffix] = sensor
        else:
            self._sensors.pop(suffix, None)
        self._scheduler.every(name, hz, lambda: self._sample(sensor), queue=name)

    def topics(self) -> list[str]:
        """The suffixes on which something is published."""
        return sorted(sensor.suffix for sensor in list(self._sensors.values()) if sensor.published)

    def _sample(self, sensor: _Sensor) -> None:
        context, suffix = self._context, sensor.suffix
        trouble, level = "", logging.WARNING
        try:
            fields = plain(sensor.provider())
            if suffix == "pose":
                fields = pose_of(fields)
            if fields is not None:
                # Peer and time are written last, so that a provider cannot speak for another peer.
                body = {**fields, "peer_id": context.peer_id, "t": context.clock()}
                context.put(topics.sensor(context.peer_id, suffix), body)
                sensor.published = True
        except NoReadingError as exc:
            trouble, level = f"{exc}", logging.INFO  # no reading is no fault
        except Exception as exc:  # noqa: BLE001 - whatever a provider raises costs its own turn alone
            trouble = f"{type(exc).__name__}: {exc}"
        # Compared without digits: an age in the text makes no new reason.
        kind = "".join(letter for letter in trouble if not letter.isdigit())
        self._troubles.note(suffix, kind, "%s: no %s is published: %s", context.peer_id, suffix, trouble, level=level)


class SensorLoopsMixin:
    """The sensor methods of a mesh peer, mixed into its class."""

    _context: Context
    _sensors: SensorPublisher
    robot: Any

    def add_sensor(self, name: str, provider: Provider, hz: float | None = None) -> None:
        """Publish the readings of ``provider``.

        Args:
            name: one of :data:`KINDS`, or ``hand/NAME``.
            provider: called on a thread of the sensors; its keys cannot override ``peer_id`` and ``t``. An error
                envelope and None are not published, and of a success only its fields are.
            hz: messages a second; the setting's by default, and 0 or less is off.

        Raises:
            ValidationError: another name.
        """
        suffix, default_hz = _suffix_and_rate(name)
        self._sensors.add(suffix, provider, default_hz if hz is None else hz)

    def add_robot_sensors(self) -> None:
        """Publish every sensor the robot itself can read, and the health of its host."""
        device = body_of(self.robot)
        own = getattr(device, "get_health", None)
        self.add_sensor("health", partial(health, _RobotHealth(own, self._context.peer_id) if callable(own) else None))
        for name, kind in KINDS.items():
            read = getattr(device, kind.method, None)
            if name != "health" and callable(read):
                self.add_sensor(name, read)
        hands = getattr(device, "get_hand_states", None)
        if callable(hands):
            for hand in getattr(device, "hand_names", ()):
                self.add_sensor(f"hand/{hand}", partial(_one_hand, hands, hand))


class _RobotHealth:
    """A robot's own health; a failure to read it is logged once."""

    def __init__(self, read: Provider, peer_id: str) -> None:
        self._read = read
        self._peer_id = peer_id
        self._troubles = TroubleLog(logger)

    def __call__(self) -> Mapping[str, Any] | None:
        fields, trouble = None, ""
        try:
            fields = plain(self._read())
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is logged
            trouble = f"{type(exc).__name__}: {exc}"
        message = "%s: the health of its robot cannot be read: %s"
        self._troubles.note("", trouble, message, self._peer_id, trouble, level=logging.INFO)
        return fields


class CameraPublisher:
    """Publishes camera frames; a camera that fails costs no other its frame.

    Off by default, and behind a privacy switch that is read before a frame is built.
    """

    def __init__(self, context: Context, frames: Frames) -> None:
        self._context = context
        self._frames = frames
        self._troubles = TroubleLog(logger)

    def publish(self) -> None:
        """Publish one frame of each camera; none is built while the privacy switch is on."""
        if not camera_enabled():
            return
        try:
            frames = self._frames()
        except Exception as exc:  # noqa: BLE001 - a robot's cameras raise what they like
            self._note("its cameras", exc)
            return
        self._note("its cameras", None)
        sent = -math.inf
        for name in frames:
            # The switch may be turned while a slow camera is waited for.
            if not camera_enabled():
                break
            try:
                peer, now = self._context.peer_id, self._context.clock()
                message = frame_message(peer, identifier("camera", name), now, frames[name])
                time.sleep(max(0.0, sent + CAMERA_SPACING_S - time.monotonic()))
                sent = time.monotonic()
                self._context.put(topics.camera(peer, name), message)
            except Exception as exc:  # noqa: BLE001 - its name, its image, its size or the link: this frame alone is lost
                self._note(f"the camera {shown(name)}", exc)
            else:
                self._note(f"the camera {shown(name)}", None)

    def _note(self, subject: str, exc: Exception | None) -> None:
        # Compared by type: the text about a frame that is too large has another size in it each time.
        kind = "" if exc is None else type(exc).__name__
        message = "%s publishes nothing of %s: %s: %s"
        self._troubles.note(subject, kind, message, self._context.peer_id, subject, kind, exc)


def camera_enabled() -> bool:
    """False while the privacy switch is on, or holds text that is no boolean."""
    return not settings.boolean("STRANDS_MESH_CAMERA_DISABLED", safe=True)


def frame_message(peer_id: str, name: str, now: float, pixels: Any) -> dict[str, Any]:
    """Encode one frame for the wire.

    Raises:
        ValidationError: ``pixels`` is no height x width x 3 array of uint8.
        MissingExtraError: Pillow is not installed.
    """
    encoded = jpeg(name, pixels)
    return {
        "peer_id": peer_id,
        "cam": name,
        "t": now,
        "shape": list(pixels.shape),
        "dtype": "uint8",
        "encoding": "jpeg",
        "data": base64.b64encode(encoded).decode(),
    }


def plain(answer: object) -> dict[str, Any] | None:
    """Return a provider's fields without those of an envelope, or None.

    Raises:
        NoReadingError: the answer is an error, or no mapping.
    """
    if answer is None:
        return None
    if not isinstance(answer, Mapping):
        raise NoReadingError(f"a reading must be a mapping, not {shown(answer)}")
    fields = dict(answer)
    if is_error(fields):
        raise NoReadingError(text_of(fields) or "no reason was given")
    if "content" in fields:
        # A status beside a content is the envelope's; alone it is the provider's own field.
        fields.pop("status", None)
        del fields["content"]
    return fields or None


def pose(fields: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return a pose with a unit quaternion, w >= 0; None where it is no rotation."""
    if fields is None:
        return None
    normalised = dict(fields)
    if "quat" in normalised:
        quat = [float(value) for value in normalised["quat"]]
        norm = math.sqrt(sum(value * value for value in quat))
        if len(quat) != 4 or not math.isfinite(norm) or norm == 0:
            return None
        normalised["quat"] = [value / norm for value in w_positive(quat)]
    return normalised


def pose_of(fields: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Like :func:`pose`; of a ROS message, the pose in it."""
    if fields is not None and isinstance(fields.get("message"), Mapping):
        return pose(from_ros(fields["message"], str(fields.get("topic", "")) or None))
    return pose(fields)


def from_ros(message: Mapping[str, Any], source: str | None = None) -> dict[str, Any]:
    """Return the pose in an odometry, pose or turtlesim message of ROS.

    ROS writes a quaternion as x, y, z, w (``geometry_msgs/Quaternion``); ``theta`` is its yaw in radians. A turtle
    lives in a plane, z = 0, and states its yaw alone. ``frame`` is None where the message names none.

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


def health(own: Provider | None = None) -> dict[str, Any]:
    """Return the host's health, and the robot's where ``own`` reads it.

    ``cpu_load`` is the one-minute load average over the number of cores, ``disk_free_gb`` in 1e9 bytes, ``mem_pct``
    the share of memory in use, ``uptime_s`` of this process, ``temps`` in degrees Celsius by zone of the host and by
    motor.
    """
    host = _host_health(int(time.monotonic() / HOST_FRESH_S))
    robot = (plain(own()) if own is not None else None) or {}
    heat = robot.get("temps")
    return {**host, **robot, "temps": {**host["temps"], **(heat if isinstance(heat, Mapping) else {})}}


@lru_cache(maxsize=1)
def _host_health(moment: int) -> dict[str, Any]:
    """Return the health of the host: the robots of a process read it once for all."""
    return {
        "battery_pct": None,
        "charging": None,
        "temps": _temperatures(),
        "cpu_load": round(os.getloadavg()[0] / (os.cpu_count() or 1), 3),
        "disk_free_gb": round(shutil.disk_usage("/").free / 1e9, 3),
        "mem_pct": _memory_in_use(),
        "uptime_s": round(time.monotonic() - STARTED, 1),
    }


def _one_hand(read: Callable[[], Mapping[str, Any]], name: str) -> Mapping[str, Any] | None:
    hands = plain(read())
    return None if hands is None else hands.get(name)


def _suffix_and_rate(name: str) -> tuple[str, float]:
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
    temperatures: dict[str, float] = {}
    for zone in sorted(Path("/sys/class/thermal").glob("thermal_zone*"))[:16]:
        with contextlib.suppress(OSError, ValueError):  # a zone without a sensor cannot be read
            name = (zone / "type").read_text(encoding="ascii").strip()
            temperatures[name] = int((zone / "temp").read_text(encoding="ascii")) / 1000
    return temperatures
