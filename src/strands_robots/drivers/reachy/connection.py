"""Connection to a daemon that may restart or fall silent, and its data.

One thread asks for the status, opens the link that the daemon speaks, and opens it again whenever joint frames stop
for 1.5 seconds: after a restart an old socket stays open and silent, so the socket's own state proves nothing.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Any

from strands_robots.bounded_json import SMALL_BYTES, json_object
from strands_robots.drivers.reachy.links import (
    APP_LOCK_SINCE,
    DEFAULT_PREFIX,
    TRANSPORTS,
    ZENOH_PORT,
    DaemonInfo,
    Link,
    PubSub,
    key_prefix,
    make_link,
)
from strands_robots.drivers.reachy.rest import (
    DaemonError,
    DaemonNotFoundError,
    DaemonUnreachableError,
    RestClient,
    prepare_stops,
)
from strands_robots.drivers.reachy.target import HeadPose
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, choice, port

logger = stop_logger(__name__)

FRESH_S = 1.5
"""Oldest sample that still counts, in seconds: joints come at 37 to 50 Hz."""

STOP_ANSWER_MAX_BYTES = 2**16
"""Longest answer to a stop, or list of running moves: a thousand moves."""

FIRST_DELAY_S, LONGEST_DELAY_S = 0.1, 1.0
WATCH_EVERY_S, POLL_EVERY_S = 0.1, 1.0
STATUS_LAG_S = 1.5
STATUS_PATH, RUNNING_PATH = "/api/daemon/status", "/api/move/running"
LOCK_PATH, APP_PATH = "/api/daemon/robot-app-lock-status", "/api/apps/current-app-status"

STORED_KINDS = frozenset({"head_pose", "imu_data", "daemon_status"})
HEAD_JOINTS = ("body_yaw", "stewart_1", "stewart_2", "stewart_3", "stewart_4", "stewart_5", "stewart_6")
JOINTS = (*HEAD_JOINTS, "right_antenna", "left_antenna")
"""Names of the motors, as :meth:`JointSample.named` gives them."""


@dataclass(frozen=True, slots=True)
class JointSample:
    """Positions in radians: body yaw, six legs of the head, antennas (right, left)."""

    head: tuple[float, ...]
    antennas: tuple[float, float]
    at: float

    @property
    def body_yaw(self) -> float:
        return self.head[0]

    def named(self) -> dict[str, float]:
        """Return the positions by motor name."""
        return dict(zip(JOINTS, (*self.head, *self.antennas), strict=True))


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Inertial sample: m/s^2, rad/s, quaternion (w, x, y, z), degrees Celsius."""

    accelerometer: tuple[float, ...]
    gyroscope: tuple[float, ...]
    quaternion: tuple[float, ...]
    temperature: float
    at: float


class Feed:
    """Latest message of each kind, written by the link's thread and read by any.

    Both generations of the daemon send the same objects, over a WebSocket with a ``type`` and over Zenoh with a key.
    Joint frames are decoded on arrival, because they show whether the link is alive; the others when they are read.
    """

    def __init__(self) -> None:
        self._raw: dict[str, tuple[str | bytes, float]] = {}
        self._joints: JointSample | None = None
        self._received_at = -math.inf
        self._news = threading.Condition()
        self.joint_frames = 0
        self.unusable_frames = 0

    def take(self, kind: str, payload: str | bytes) -> None:
        """Store one message; a joint frame that cannot be decoded is dropped.

        So is any message beyond :data:`~strands_robots.bounded_json.SMALL_BYTES`, which is not parsed.
        """
        now = time.monotonic()
        if len(payload) > SMALL_BYTES:
            self.unusable_frames += 1
            return
        if kind != "joint_positions":
            if kind in STORED_KINDS:
                self._raw[kind] = (payload, now)
            return
        joints = _joints(payload, now)
        with self._news:
            self._received_at = now
            if joints is None:
                self.unusable_frames += 1
                return
            self._joints = joints
            self.joint_frames += 1
            self._news.notify_all()

    def clear(self) -> None:
        """Forget everything, for a new link."""
        with self._news:
            self._raw.clear()
            self._joints = None
            self._received_at = -math.inf

    def wait(self, within_s: float) -> bool:
        """Wait for a usable joint frame; False when ``within_s`` are over."""
        with self._news:
            return self._news.wait_for(lambda: self._joints is not None, within_s)

    @property
    def silent_s(self) -> float:
        """Seconds since any joint frame, usable or not; infinite before the first."""
        return time.monotonic() - self._received_at

    @property
    def alive(self) -> bool:
        """Joint frames arrive."""
        return self.silent_s <= FRESH_S

    @property
    def joints(self) -> JointSample | None:
        """The last usable joint positions, however old."""
        return self._joints

    @property
    def fresh_joints(self) -> JointSample | None:
        """The last joint positions unless they are stale."""
        joints = self._joints
        return joints if joints is not None and time.monotonic() - joints.at <= FRESH_S else None

    def pose(self) -> HeadPose | None:
        """Return the measured head pose, or None when stale or unusable."""
        message = self._object("head_pose", FRESH_S)
        rows = message.get("head_pose") if message else None
        if not isinstance(rows, list):
            return None
        flat = [value for row in rows for value in (row if isinstance(row, list) else [row])]
        try:
            return HeadPose.from_matrix(flat)
        except (ValidationError, TypeError):
            return None

    def imu(self) -> ImuSample | None:
        """Return the last inertial sample, however old, or None on a robot without one."""
        message = self._object("imu_data", math.inf)
        if message is None:
            return None
        accelerometer, gyroscope = (_numbers(message.get(key), 3) for key in ("accelerometer", "gyroscope"))
        quaternion, temperature = _numbers(message.get("quaternion"), 4), _numbers([message.get("temperature")], 1)
        if accelerometer is None or gyroscope is None or quaternion is None or temperature is None:
            return None
        return ImuSample(accelerometer, gyroscope, quaternion, temperature[0], self._raw["imu_data"][1])

    def status(self) -> dict[str, Any] | None:
        """Return the daemon's status, sent every second, unless older than three."""
        return self._object("daemon_status", 3.0)

    def _object(self, kind: str, within_s: float) -> dict[str, Any] | None:
        payload, at = self._raw.get(kind, ("", -math.inf))
        if time.monotonic() - at > within_s or not payload:
            return None
        return json_object(payload, SMALL_BYTES) or None


def _joints(payload: str | bytes, at: float) -> JointSample | None:
    message = json_object(payload, SMALL_BYTES)
    head = _numbers(message.get("head_joint_positions"), 7)
    antennas = _numbers(message.get("antennas_joint_positions"), 2)
    return JointSample(head, (antennas[0], antennas[1]), at) if head and antennas else None


def _numbers(values: object, length: int) -> tuple[float, ...] | None:
    """Return ``length`` finite numbers, or None; NaN arrives as null or as bare NaN."""
    if not isinstance(values, list) or len(values) != length:
        return None
    good = all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values)
    return tuple(float(v) for v in values) if good else None


class Connection:
    """Connection to one daemon; ``start`` it, and check ``refusal`` before sending.

    Args:
        host: bare hostname or IP literal of the daemon.
        api_port: its TCP port.
        prefix: of the Zenoh keys; the default gives way to the robot's own name.
        transport: ``auto`` for the link that the daemon speaks, or a link's name.
        session: a pub/sub object for the Zenoh link in place of a session of its own.
        zenoh_port: Zenoh port of a daemon before 1.5.
    """

    def __init__(
        self,
        host: str,
        api_port: int = 8000,
        *,
        prefix: str = DEFAULT_PREFIX,
        transport: str = "auto",
        session: PubSub | None = None,
        zenoh_port: int = ZENOH_PORT,
    ) -> None:
        self.rest = RestClient(host, api_port)
        self.stop_rest = RestClient(host, api_port, longest=STOP_ANSWER_MAX_BYTES)
        self.hub_rest = RestClient(host, api_port, read_s=10.0)
        self.host, self.port = self.rest.host, self.rest.port
        self._prefix = key_prefix(prefix)
        self._transport = choice("transport", transport, TRANSPORTS)
        self._session, self._zenoh_port = session, port("zenoh_port", zenoh_port)
        self.feed = Feed()
        self.connects = 0
        self.holder = ""
        """Application that holds the robot, as last polled; empty for none."""
        self.moves: frozenset[str] = frozenset()
        """Uuids of the daemon's running moves, as last polled."""
        self._info: DaemonInfo | None = None
        self._link: Link | None = None
        self._reason = "not connected"
        self._answered_mode = ("", 0.0)
        self._stopping = threading.Event()
        self._up = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to connect, in a thread; returns at once."""
        if self._thread is not None:
            return
        self._stopping.clear()
        prepare_stops()
        self._thread = threading.Thread(target=self._run, name="reachy-watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disconnect and end the thread."""
        self._stopping.set()
        self._up.clear()
        thread, self._thread = self._thread, None
        self._reason = "disconnected"
        self._drop()
        if thread is not None and thread is not threading.current_thread():
            thread.join(5.0)
        for client in (self.rest, self.stop_rest, self.hub_rest):
            client.close()

    def wait(self, within_s: float) -> bool:
        """Wait for the link; True when it is up within the time."""
        return self._up.wait(within_s)

    @property
    def info(self) -> DaemonInfo | None:
        """The daemon's newest status, from the stream or else of the last connection."""
        streamed = self.feed.status()
        return DaemonInfo.of(streamed) if streamed else self._info

    @property
    def motor_mode(self) -> str:
        """The motors' mode by the daemon's last answer or, if newer, its status."""
        mode, at = self._answered_mode
        if time.monotonic() - at < STATUS_LAG_S:
            return mode
        info = self.info
        return info.motor_mode if info is not None else ""

    def note_mode(self, mode: str) -> None:
        """Remember the motors' mode that the daemon just answered."""
        self._answered_mode = (mode, time.monotonic())

    @property
    def link_kind(self) -> str:
        """One of websocket, zenoh; empty while there is no link."""
        link = self._link
        return link.kind if link is not None else ""

    @property
    def alive(self) -> bool:
        """The link is open and joint frames arrive."""
        link = self._link
        return self._up.is_set() and link is not None and not link.closed and self.feed.alive

    def refusal(self) -> str | None:
        """Return the reason why nothing may be sent now, or None."""
        if not self.alive:
            silent = self._up.is_set() and not self.feed.alive
            return f"no joint data for {self.feed.silent_s:.1f} s" if silent else self._reason
        if holder := self.holder:
            return f"the robot is held by {holder}"
        return None

    def link(self) -> Link:
        """Return the open link. Raises :class:`DaemonUnreachableError`."""
        link = self._link
        if link is None or not self._up.is_set():
            raise DaemonUnreachableError(f"Reachy Mini at {self.host}:{self.port} is not connected: {self._reason}.")
        return link

    def _run(self) -> None:
        delay = FIRST_DELAY_S
        while not self._stopping.is_set():
            try:
                self._open()
                self._poll()
            except Exception as exc:
                # The device stays, reports why it is unavailable, and tries again after any error.
                self._unavailable(str(exc) or type(exc).__name__)
                if not isinstance(exc, DaemonError | ImportError):
                    logger.exception("Reachy Mini at %s:%d: connecting failed.", self.host, self.port)
                self._drop()
                self._stopping.wait(delay)
                delay = min(2 * delay, LONGEST_DELAY_S)
                continue
            delay = FIRST_DELAY_S
            self._watch()
            self._drop()

    def _open(self) -> None:
        info = self._info = DaemonInfo.of(self.rest.get(STATUS_PATH))
        if info.state not in ("running", ""):
            raise DaemonError(f"the daemon is {info.state}{': ' + info.error if info.error else ''}")
        self.feed.clear()
        link = self._link = make_link(
            info,
            self.host,
            self.port,
            prefix=self._prefix,
            transport=self._transport,
            session=self._session,
            zenoh_port=self._zenoh_port,
        )
        link.open(self.feed.take)
        deadline = time.monotonic() + FRESH_S
        while not self.feed.alive:
            if self._stopping.is_set() or link.closed or time.monotonic() > deadline:
                raise DaemonUnreachableError(f"the {link.kind} link opened but carries no joint data")
            self.feed.wait(0.05)
        if self._stopping.is_set():
            raise DaemonUnreachableError("disconnected")
        self.connects += 1
        self._reason = ""
        self._up.set()
        version = ".".join(map(str, info.version)) or "of unknown version"
        logger.info("Reachy Mini at %s:%d: daemon %s over %s.", self.host, self.port, version, link.kind)

    def _watch(self) -> None:
        """Poll until the link is dead."""
        polled = time.monotonic()
        while not self._stopping.wait(WATCH_EVERY_S):
            link = self._link
            if link is None or link.closed:
                self._unavailable("the daemon closed the link")
                return
            if not self.feed.alive:
                self._unavailable(f"no joint data for {FRESH_S:g} s")
                return
            if time.monotonic() - polled >= POLL_EVERY_S:
                try:
                    self._poll()
                except DaemonError as exc:
                    logger.info("Reachy Mini at %s:%d: %s", self.host, self.port, exc)
                polled = time.monotonic()

    def _poll(self) -> None:
        info = self._info
        self.holder = self._ask_holder(info) if info is not None else ""
        # The moves are asked for over the stop's own connection, which is thereby open and warm when a stop comes.
        self.moves = running_moves(self.stop_rest.get(RUNNING_PATH))

    def _ask_holder(self, info: DaemonInfo) -> str:
        """Return the application that holds the robot, by the daemon's lock or app."""
        if info.since(APP_LOCK_SINCE):
            lock = self.rest.get(LOCK_PATH)
            if isinstance(lock, dict) and lock.get("state") not in ("free", None):
                return str(lock.get("holder_name") or lock["state"])
        try:
            app = self.rest.get(APP_PATH)
        except DaemonNotFoundError:
            return ""
        if isinstance(app, dict) and app.get("state") in ("starting", "running", "stopping"):
            about = app.get("info")
            return str(about.get("name") if isinstance(about, dict) else "an application")
        return ""

    def _drop(self) -> None:
        self._up.clear()
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _unavailable(self, reason: str) -> None:
        reason = reason.rstrip(".")
        if reason != self._reason and not self._stopping.is_set():
            logger.warning("Reachy Mini at %s:%d is unavailable: %s.", self.host, self.port, reason)
            self._reason = reason


def running_moves(answer: Any) -> frozenset[str]:
    """Return the uuids of an answer of ``/api/move/running``; refuse another shape."""
    if not isinstance(answer, list) or not all(isinstance(move, dict) and "uuid" in move for move in answer):
        raise ValidationError("the daemon's list of running moves is no list of uuids.")
    return frozenset(str(move["uuid"]) for move in answer)
