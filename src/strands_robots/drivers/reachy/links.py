"""The two ways to stream to a daemon: a WebSocket since 1.5, Zenoh before.

A link sends and hands what it hears to a sink; it neither judges liveness nor reconnects, the driver does. Nothing is
acknowledged by the daemon on either. Third parties are loaded by ``open``.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from strands_robots.drivers.reachy.envelope import Target
from strands_robots.drivers.reachy.feed import Sink
from strands_robots.drivers.reachy.rest import CONNECT_S, DaemonUnreachable, checked_host, dialled
from strands_robots.drivers.reachy.websocket import open_socket
from strands_robots.utils import ValidationError, identifier, missing_extra, shown

logger = logging.getLogger(__name__)

ZENOH_PORT = 7447
OUT_TOPICS = ("joint_positions", "head_pose", "imu_data", "daemon_status")


class Link(Protocol):
    """A stream to one daemon."""

    kind: str

    def open(self, sink: Sink) -> None:
        """Connect and hand every message to ``sink``. Raises :class:`DaemonUnreachable`."""

    def close(self) -> None:
        """Let go; sending afterwards raises :class:`DaemonUnreachable`."""

    @property
    def closed(self) -> bool:
        """The transport itself knows that it is gone. Only data says that it is alive."""

    def send_target(self, target: Target) -> None:
        """Go there with the next control tick. Checked values only."""

    def send_torque(self, on: bool, ids: Sequence[str] | None) -> None:
        """Torque of some motors by name, None all."""

    def send_automatic_body_yaw(self, on: bool) -> None:
        """Let the daemon turn the body along with the head."""

    def stop_move(self) -> bool:
        """End the daemon's current move where the link has a word for it; False where it has none."""


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
        self._gone = threading.Event()

    def open(self, sink: Sink) -> None:
        self._stack = contextlib.ExitStack()
        self._socket = open_socket(self._stack, self._host, self._port, "/ws/sdk")
        self._gone.clear()
        threading.Thread(target=self._read, args=(self._socket, sink), name="reachy-link", daemon=True).start()

    def close(self) -> None:
        self._gone.set()
        self._socket = None
        self._stack.close()

    @property
    def closed(self) -> bool:
        return self._gone.is_set()

    def send_target(self, target: Target) -> None:
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
        self.send({"type": "set_torque", "on": on, **({"ids": list(ids)} if ids is not None else {})})

    def send_automatic_body_yaw(self, on: bool) -> None:
        self.send({"type": "set_automatic_body_yaw", "enabled": on})

    def stop_move(self) -> bool:
        if self._can_stop:
            self.send({"type": "stop_move"})
        return self._can_stop

    def send(self, message: dict[str, Any]) -> None:
        """One object as a text frame: the daemon drops the connection at a binary one."""
        current = self._socket
        if current is None or self._gone.is_set():
            raise DaemonUnreachable("The link to the daemon is closed.")
        try:
            current.send(json.dumps(message, allow_nan=False, separators=(",", ":")))
        except Exception as exc:
            self._gone.set()
            raise DaemonUnreachable(f"The link to the daemon broke: {exc}.") from exc

    def _read(self, socket: Any, sink: Sink) -> None:
        """Hand on each frame until the connection ends, whatever ends it."""
        try:
            for frame in socket:
                sink(_kind(frame), frame)
        except Exception as exc:  # noqa: BLE001 - a foreign connection may end in any way; the driver reconnects
            logger.info("The link to %s ended: %s", self._host, exc)
        finally:
            if socket is self._socket or self._socket is None:
                self._gone.set()


def _kind(frame: str | bytes) -> str:
    """The ``type`` of a frame; it stands first in every one of the daemon's but the IMU's, where it is last."""
    if isinstance(frame, bytes):
        return ""
    if frame.startswith('{"type":"'):
        return frame[9 : frame.find('"', 9)]
    try:
        found = json.loads(frame)
    except ValueError:
        return ""
    return str(found.get("type", "")) if isinstance(found, dict) else ""


@runtime_checkable
class PubSub(Protocol):
    """What a :class:`ZenohLink` needs of a session."""

    def subscribe(self, key: str, heard: Callable[[bytes], None]) -> Callable[[], None]:
        """Call ``heard`` with each payload under ``key``; the result unsubscribes."""

    def publish(self, key: str, payload: bytes) -> None:
        """Put one payload."""

    def close(self) -> None:
        """End the session."""


def key_prefix(value: object) -> str:
    """A ``/``-joined sequence of identifiers; a wildcard would reach every robot under it.

    Raises:
        ValidationError: naming the part that is none.
    """
    if not isinstance(value, str) or not value:
        raise ValidationError(f"prefix must be identifiers joined by '/', not {shown(value)}.")
    for part in value.split("/"):
        identifier(f"prefix part of {shown(value)}", part)
    return value


class ZenohLink:
    """Keys under a prefix, on a session that it is given or on a client session of its own to the daemon.

    Args:
        host: where the daemon's Zenoh router listens, port 7447, when no ``session`` is given.
        prefix: of the robot's keys.
        session: a :class:`PubSub` to use in place of an own one; it stays open when the link closes.
    """

    kind = "zenoh"

    def __init__(
        self, host: str, prefix: str = "reachy_mini", *, session: PubSub | None = None, zenoh_port: int = ZENOH_PORT
    ) -> None:
        self._host, self._port, self._prefix = checked_host(host), zenoh_port, key_prefix(prefix)
        self._given, self._session = session, session
        self._leave: list[Callable[[], None]] = []
        self._open = False

    def open(self, sink: Sink) -> None:
        session = self._given or ClientSession(f"tcp/{dialled(self._host)}:{self._port}")
        self._session = session
        for topic in OUT_TOPICS:
            self._leave.append(session.subscribe(f"{self._prefix}/{topic}", _Into(topic, sink)))
        self._open = True

    def close(self) -> None:
        self._open = False
        leave, self._leave = self._leave, []
        session, self._session = self._session, self._given
        for unsubscribe in leave:
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
        """One object to ``<prefix>/command``."""
        session = self._session
        if session is None or not self._open:
            raise DaemonUnreachable("The link to the daemon is closed.")
        try:
            session.publish(f"{self._prefix}/command", json.dumps(command, allow_nan=False).encode())
        except Exception as exc:
            raise DaemonUnreachable(f"The link to the daemon broke: {exc}.") from exc


class _Into:
    """Hands payloads of one topic to the sink."""

    def __init__(self, topic: str, sink: Sink) -> None:
        self._topic, self._sink = topic, sink

    def __call__(self, payload: bytes) -> None:
        self._sink(self._topic, payload)


class ClientSession:
    """A Zenoh session in client mode to one endpoint, scouting off: two robots of one prefix never cross-talk."""

    def __init__(self, endpoint: str) -> None:
        try:
            import zenoh  # noqa: PLC0415 - optional, only daemons before 1.5 need it
        except ImportError as exc:
            raise missing_extra("A Reachy Mini daemon before 1.5", "reachy") from exc
        config = zenoh.Config()
        for key, value in (
            ("mode", "client"),
            ("connect/endpoints", [endpoint]),
            ("connect/timeout_ms", int(CONNECT_S * 1000)),
            ("scouting/multicast/enabled", False),
            ("scouting/gossip/enabled", False),
        ):
            config.insert_json5(key, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as exc:
            raise DaemonUnreachable(f"{endpoint} did not open: {exc}.") from exc
        self._zenoh_error = zenoh.ZError

    def subscribe(self, key: str, heard: Callable[[bytes], None]) -> Callable[[], None]:
        subscriber = self._session.declare_subscriber(key, lambda sample: heard(sample.payload.to_bytes()))

        def unsubscribe() -> None:
            # A session that already ended has dropped its subscribers with it.
            with contextlib.suppress(self._zenoh_error):
                subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's own stub lacks it

        return unsubscribe

    def publish(self, key: str, payload: bytes) -> None:
        self._session.put(key, payload)

    def close(self) -> None:
        with contextlib.suppress(self._zenoh_error):  # closing twice is fine
            self._session.close()  # type: ignore[no-untyped-call]  # zenoh's own stub lacks it
