"""Streams to a daemon: a WebSocket since 1.5, Zenoh before.

A link sends, and hands every received message to a sink; the connection judges liveness and reconnects. The daemon
acknowledges nothing on either. Third parties are loaded by ``open``.

The badge ``wireless_version`` does not decide: daemons 1.0.0 to 1.4.1 speak Zenoh on every robot, 1.5.0 and newer a
WebSocket on every robot (measured on 1.4.1, 1.5.0, 1.9.0 and 1.13.0). The badge is used only where the daemon reports
neither a version nor a type.
"""

from __future__ import annotations

import contextlib
import json
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from strands_robots.bounded_json import SMALL_BYTES, json_object
from strands_robots.drivers.reachy.rest import (
    CONNECT_S,
    DaemonAccess,
    DaemonFaultError,
    DaemonUnreachableError,
    checked_host,
    url_host,
    warn_once,
)
from strands_robots.drivers.reachy.target import Target
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, identifier, missing_extra, optional_module, shown
from strands_robots.zenoh_session import LinkedSession, undeclare

logger = stop_logger(__name__)

ZENOH_PORT = 7447
DEFAULT_PREFIX = "reachy_mini"
OUT_TOPICS = ("joint_positions", "head_pose", "imu_data", "daemon_status")
TRANSPORTS = ("auto", "websocket", "zenoh")

WEBSOCKET_SINCE = (1, 5)
PREFIX_SINCE = (1, 2)
FULL_TARGET_SINCE = (1, 6)
APP_LOCK_SINCE = (1, 7)
STOP_MOVE_SINCE = (1, 10)
SLEEP_DISABLES_SINCE = (1, 10)

_VERSION = re.compile(r"(\d+)\.(\d+)(?:\.(\d+))?")

Sink = Callable[[str, str | bytes], None]
"""Takes the kind and the text of a received message."""


def open_socket(stack: contextlib.ExitStack, host: str, api_port: int, path: str) -> Any:
    """Open a WebSocket that closes with ``stack``; raises ``DaemonUnreachableError``."""
    try:
        from websockets.exceptions import WebSocketException  # noqa: PLC0415 - optional, loaded by the first link
        from websockets.sync.client import connect  # noqa: PLC0415 - the same
    except ImportError as exc:
        raise missing_extra("Reachy Mini", "reachy") from exc
    access = DaemonAccess.stated(host)
    url = f"{access.url('ws', api_port)}{path}"
    try:
        return stack.enter_context(
            connect(
                url,
                # A frame of 300 bytes costs more to inflate than to carry.
                compression=None,
                # Data shows life.
                ping_interval=None,
                max_size=SMALL_BYTES,
                open_timeout=CONNECT_S,
                close_timeout=0.5,
                proxy=None,
                ssl=access.context,
                additional_headers=access.headers,
            )
        )
    except (OSError, WebSocketException) as exc:
        raise DaemonUnreachableError(f"{url} did not open: {exc}.") from exc


class WebSocketLink:
    """``ws://host:port/ws/sdk``: text frames, one JSON object each.

    Args:
        full_target: send all parts in one frame (daemon 1.6 and newer).
        can_stop: the daemon knows ``stop_move`` (1.10 and newer).
    """

    kind = "websocket"

    def __init__(self, host: str, api_port: int = 8000, *, full_target: bool = True, can_stop: bool = True) -> None:
        self._host, self._port = checked_host(host), api_port
        self._full_target, self._can_stop = full_target, can_stop
        self._socket: Any = None
        self._stack = contextlib.ExitStack()
        self._closed = threading.Event()

    def open(self, sink: Sink) -> None:
        """Connect and hand every message to ``sink``; raises ``DaemonUnreachableError``."""
        self._stack = contextlib.ExitStack()
        self._socket = open_socket(self._stack, self._host, self._port, "/ws/sdk")
        self._closed.clear()
        threading.Thread(target=self._read, args=(self._socket, sink), name="reachy-link", daemon=True).start()

    def close(self) -> None:
        """Disconnect; sending afterwards raises :class:`DaemonUnreachableError`."""
        self._closed.set()
        self._socket = None
        self._stack.close()

    @property
    def closed(self) -> bool:
        """The transport reports that it is closed; an open one may still be dead."""
        return self._closed.is_set()

    def send_target(self, target: Target) -> None:
        """Go to a checked target with the next control tick."""
        parts: dict[str, Any] = {}
        if target.head is not None:
            parts["head"] = target.head.matrix()
        if target.antennas is not None:
            parts["antennas"] = list(target.antennas)
        if target.body_yaw is not None:
            parts["body_yaw"] = target.body_yaw
        if len(parts) > 1 and self._full_target:
            self.send({"type": "set_full_target", **parts})
            return
        kinds = {"head": "set_target", "antennas": "set_antennas", "body_yaw": "set_body_yaw"}
        for name, value in parts.items():
            self.send({"type": kinds[name], name: value})

    def send_torque(self, on: bool, ids: Sequence[str] | None) -> None:
        """Switch the torque of some motors by name, or of all for None."""
        self.send({"type": "set_torque", "on": on, **({"ids": list(ids)} if ids is not None else {})})

    def send_automatic_body_yaw(self, on: bool) -> None:
        """Let the daemon turn the body along with the head."""
        self.send({"type": "set_automatic_body_yaw", "enabled": on})

    def stop_move(self) -> bool:
        """End the daemon's current move; False where the link has no such message."""
        if self._can_stop:
            self.send({"type": "stop_move"})
        return self._can_stop

    def send(self, message: dict[str, Any]) -> None:
        """Send one object as text; the daemon closes the connection at a binary frame."""
        current = self._socket
        if current is None or self._closed.is_set():
            raise DaemonUnreachableError("The link to the daemon is closed.")
        try:
            current.send(json.dumps(message, allow_nan=False, separators=(",", ":")))
        except Exception as exc:
            self._closed.set()
            raise DaemonUnreachableError(f"The link to the daemon broke: {exc}.") from exc

    def _read(self, socket: Any, sink: Sink) -> None:
        try:
            for frame in socket:
                sink(_kind(frame), frame)
        except Exception as exc:  # noqa: BLE001 - a foreign connection may end in any way; the driver reconnects
            logger.info("The link to %s ended: %s", self._host, exc)
        finally:
            if socket is self._socket or self._socket is None:
                self._closed.set()


def _kind(frame: str | bytes) -> str:
    """Return the ``type`` of a frame: its first key, but the IMU frame's last."""
    if isinstance(frame, bytes):
        return ""
    if frame.startswith('{"type":"'):
        return frame[9 : frame.find('"', 9)]
    return str(json_object(frame, SMALL_BYTES).get("type", ""))


class PubSub(Protocol):
    """The part of a pub/sub session that :class:`ZenohLink` uses."""

    def subscribe(self, key: str, on_payload: Callable[[bytes], None], /) -> Callable[[], None]:
        """Call ``on_payload`` with each payload under ``key``; the result unsubscribes."""

    def publish(self, key: str, payload: bytes) -> None:
        """Put one payload."""

    def close(self) -> None:
        """End the session."""


def key_prefix(value: object) -> str:
    """Return a ``/``-joined sequence of identifiers, none of them a wildcard.

    Raises:
        ValidationError: naming the part that is no identifier.
    """
    if not isinstance(value, str) or not value:
        raise ValidationError(f"prefix must be identifiers joined by '/', not {shown(value)}.")
    for part in value.split("/"):
        identifier(f"prefix part of {shown(value)}", part)
    return value


class ZenohLink:
    """Keys under a prefix, on a given session or on one of its own to the daemon.

    It has the methods of :class:`WebSocketLink`.

    Args:
        host: of the daemon's Zenoh router, port 7447, when no ``session`` is given.
        prefix: of the robot's keys.
        session: a :class:`PubSub` to use in place of an own one; it stays open when the link closes.
    """

    kind = "zenoh"

    def __init__(
        self, host: str, prefix: str = DEFAULT_PREFIX, *, session: PubSub | None = None, zenoh_port: int = ZENOH_PORT
    ) -> None:
        self._host, self._port, self._prefix = checked_host(host), zenoh_port, key_prefix(prefix)
        self._given, self._session = session, session
        self._unsubscribe: list[Callable[[], None]] = []
        self._open = False

    def open(self, sink: Sink) -> None:
        session = self._given or ClientSession(f"tcp/{url_host(self._host)}:{self._port}")
        self._session = session
        for topic in OUT_TOPICS:
            self._unsubscribe.append(session.subscribe(f"{self._prefix}/{topic}", partial(sink, topic)))
        self._open = True

    def close(self) -> None:
        self._open = False
        subscriptions, self._unsubscribe = self._unsubscribe, []
        session, self._session = self._session, self._given
        for unsubscribe in subscriptions:
            unsubscribe()
        if session is not None and session is not self._given:
            session.close()

    @property
    def closed(self) -> bool:
        return not self._open

    def send_target(self, target: Target) -> None:
        command: dict[str, Any] = {}
        if target.head is not None:
            flat = target.head.matrix()
            command["head_pose"] = [flat[i : i + 4] for i in (0, 4, 8, 12)]
        if target.antennas is not None:
            command["antennas_joint_positions"] = list(target.antennas)
        if target.body_yaw is not None:
            command["body_yaw"] = target.body_yaw
        self.send_cmd(command)

    def send_torque(self, on: bool, ids: Sequence[str] | None) -> None:
        # Without the key `ids` the daemon fails inside and changes nothing.
        self.send_cmd({"torque": on, "ids": list(ids) if ids is not None else None})

    def send_automatic_body_yaw(self, on: bool) -> None:
        self.send_cmd({"automatic_body_yaw": on})

    def stop_move(self) -> bool:
        return False

    def send_cmd(self, command: dict[str, Any]) -> None:
        """Publish one object to ``<prefix>/command``."""
        session = self._session
        if session is None or not self._open:
            raise DaemonUnreachableError("The link to the daemon is closed.")
        try:
            session.publish(f"{self._prefix}/command", json.dumps(command, allow_nan=False).encode())
        except Exception as exc:
            raise DaemonUnreachableError(f"The link to the daemon broke: {exc}.") from exc


Link = WebSocketLink | ZenohLink


class ClientSession:
    """A Zenoh client session to one endpoint without scouting, against cross-talk."""

    def __init__(self, endpoint: str) -> None:
        zenoh = optional_module("zenoh", what="A Reachy Mini daemon before 1.5", extra="reachy")
        config = {
            "mode": "client",
            "connect": {"endpoints": [endpoint], "timeout_ms": int(CONNECT_S * 1000)},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        try:
            self._session = LinkedSession(config)
        except zenoh.ZError as exc:
            raise DaemonUnreachableError(f"{endpoint} did not open: {exc}.") from exc
        self._session.watch_links()

    def subscribe(self, key: str, on_payload: Callable[[bytes], None], /) -> Callable[[], None]:
        def deliver(sample: Any) -> None:
            if len(sample.payload) <= SMALL_BYTES:
                on_payload(sample.payload.to_bytes())

        return partial(undeclare, self._session.subscribe(key, deliver))

    def publish(self, key: str, payload: bytes) -> None:
        self._session.session.put(key, payload)

    def close(self) -> None:
        self._session.close()


@dataclass(frozen=True, slots=True)
class DaemonInfo:
    """The daemon's status object; ``version`` is empty where it reports none."""

    raw: dict[str, Any]
    version: tuple[int, ...] = ()

    @classmethod
    def of(cls, status: object) -> DaemonInfo:
        """Read a status. Raises :class:`DaemonFaultError` for anything but an object."""
        if not isinstance(status, dict):
            raise DaemonFaultError(f"the daemon's status is no object: {shown(status)}.")
        match = _VERSION.match(str(status.get("version") or ""))
        return cls(status, tuple(int(part or 0) for part in match.groups()) if match else ())

    def since(self, version: tuple[int, ...]) -> bool:
        """Return True for that version or newer; without one, for the new status type."""
        return self.version >= version if self.version else self.raw.get("type") == "daemon_status"

    @property
    def state(self) -> str:
        """State by the daemon's name, such as running or stopped; empty for none."""
        return str(self.raw.get("state") or "")

    @property
    def error(self) -> str:
        return str(self.raw.get("error") or "")

    @property
    def motor_mode(self) -> str:
        """One of enabled, disabled, gravity_compensation; empty while no backend runs."""
        backend = self.raw.get("backend_status")
        return str(backend.get("motor_control_mode") or "") if isinstance(backend, dict) else ""

    @property
    def link(self) -> str:
        """The link that this daemon serves: websocket or zenoh."""
        if self.raw.get("type") == "daemon_status" or self.version >= WEBSOCKET_SINCE:
            return "websocket"
        return "zenoh" if self.version or self.raw.get("wireless_version") is True else "websocket"

    def prefix(self, requested: str) -> str:
        """Return the key prefix: the caller's own, else the robot's name if in use."""
        name = self.raw.get("robot_name")
        if requested != DEFAULT_PREFIX or not isinstance(name, str) or self.version < PREFIX_SINCE:
            return requested
        try:
            return key_prefix(name)
        except ValidationError as exc:
            raise DaemonFaultError(f"the daemon's robot_name cannot be a key prefix: {exc}") from exc


def make_link(
    info: DaemonInfo,
    host: str,
    api_port: int,
    *,
    prefix: str,
    transport: str = "auto",
    session: PubSub | None = None,
    zenoh_port: int = ZENOH_PORT,
) -> Link:
    """Return the link for a daemon, not yet open; ``transport`` may override it."""
    kind = info.link if transport == "auto" else transport
    if kind == "zenoh":
        access = DaemonAccess.stated(host)
        if session is None and (access.tls or access.token):
            warn_once(f"The daemon at {host} speaks Zenoh, which no REACHY_DAEMON_ setting encrypts or authenticates.")
        return ZenohLink(host, info.prefix(prefix), session=session, zenoh_port=zenoh_port)
    return WebSocketLink(
        host, api_port, full_target=info.since(FULL_TARGET_SINCE), can_stop=info.since(STOP_MOVE_SINCE)
    )
