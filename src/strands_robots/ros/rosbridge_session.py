"""Frames of the rosbridge v2 protocol, and the WebSockets that carry them.

A frame is a JSON object with an ``op``; long ones come in fragments, bytes as base64. Source: ``ROSBRIDGE_PROTOCOL.md``
of rosbridge_suite. ``status`` is no longer in it, but servers still send it.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import json
import logging
import ssl
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha512
from itertools import count
from secrets import token_hex
from socket import SHUT_RDWR, SO_LINGER, SOL_SOCKET
from typing import Any

from strands_robots.bounded_json import LONG_MAX, MESSAGE_MAX, OutOfBoundsError, parsed
from strands_robots.ros.link import Message, NoReceiptError, RosError, bare_kind
from strands_robots.utils import ValidationError, dial_host_error, mapping, optional_module, port, shown, text

logger = logging.getLogger(__name__)

BACKOFF_S = (0.1, 2.0)
"""First and longest pause between two attempts to reopen a lost connection."""

TICK_S = 1.0
"""Seconds between two looks at what has to be asked again."""

CONFIRM_S = 0.5
"""Seconds within which a living server confirms that a zero has arrived."""

_PING_S = 2.0
_CLOSE_S = 0.5

FRAME_MAX = 8 * 2**20
"""Longest frame in bytes: a raw 1080p image in base64 fits."""

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
    """Encode a frame; NaN and other non-JSON values raise :class:`RosError`."""
    try:
        return _encoder.encode({"op": op, **fields})
    except (TypeError, ValueError, RecursionError) as exc:
        raise RosError(f"{op} cannot be sent as JSON: {exc}") from exc


def decoded(frame: str | bytes) -> dict[str, Any]:
    """Decode a frame; :class:`RosError` where it is no object with an ``op``."""
    try:
        # A text is that of a frame already; bytes are copied to read them.
        found = parsed(frame, FRAME_MAX if isinstance(frame, str) else MESSAGE_MAX)
    except OutOfBoundsError as exc:
        raise RosError(f"a frame cannot be read: {exc}") from exc
    except ValueError as exc:
        raise RosError(f"a frame is no JSON: {exc}") from exc
    if not isinstance(found, dict) or not isinstance(found.get("op"), str):
        raise RosError("a frame is no object with an op")
    return found


def with_bytes(kind: str | None, message: Mapping[str, Any]) -> dict[str, Any]:
    """Return the message with the ``uint8[]`` of a known type as ``bytes``."""
    plain = dict(message)
    field = BYTE_FIELDS.get(bare_kind(kind)) if kind else None
    if field is not None and field in plain:
        plain[field] = _as_bytes(plain[field])
    return plain


def _as_bytes(value: object) -> bytes:
    """Decode a ``uint8[]`` of either spelling, base64 or a list of numbers."""
    try:
        if isinstance(value, str):
            return base64.b64decode(value, validate=True)
        if isinstance(value, list):
            return bytes(value)
    except (binascii.Error, ValueError, TypeError) as exc:
        raise RosError(f"a uint8[] is neither base64 nor a list of bytes: {exc}") from exc
    raise RosError("a uint8[] is neither base64 nor a list of bytes")


class Fragments:
    """Reassembly of ``fragment`` operations, bounded in number and size."""

    def __init__(self) -> None:
        self._partial: dict[str, dict[int, str]] = {}
        self._size = 0

    def add(self, frame: Mapping[str, Any]) -> dict[str, Any] | None:
        """Add a fragment; return the whole message once it is complete."""
        key, number, total, data = (frame.get(name) for name in ("id", "num", "total", "data"))
        numbered = type(number) is int and type(total) is int and 0 <= number < total <= FRAGMENTS_MAX
        if not (isinstance(key, str) and numbered and isinstance(data, str)):
            raise RosError("a fragment lacks its id, number, total or data")
        assert isinstance(number, int)
        parts = self._partial.setdefault(key, {})
        self._size += len(data) - len(parts.get(number, ""))
        parts[number] = data
        while len(self._partial) > PARTIAL_MAX or (self._size > LONG_MAX and len(self._partial) > 1):
            # The oldest gives way, this one last.
            self._drop(next(each for each in self._partial if each != key))
        if self._size > LONG_MAX:
            self._drop(key)
            raise RosError(f"the fragments of a message are longer than {LONG_MAX} characters")
        if len(parts) != total:
            return None
        self._drop(key)
        return decoded("".join(parts[index] for index in sorted(parts)))

    def _drop(self, key: str) -> None:
        self._size -= sum(map(len, self._partial.pop(key).values()))


def _plain(value: Any) -> Any:
    if isinstance(value, bytes | bytearray):
        return base64.b64encode(value).decode("ascii")
    listed = getattr(value, "tolist", None)
    if callable(listed):
        return listed()
    raise TypeError(f"{type(value).__name__} has no JSON form")


_encoder = json.JSONEncoder(allow_nan=False, default=_plain)


@dataclass(frozen=True)
class RosbridgeAccess:
    """TLS, headers and secret of a server that is not open to everyone.

    Args:
        tls: true for ``wss`` with the system's authorities; a path: with those of this PEM file alone.
        headers: of the WebSocket's request, such as ``Authorization`` for a proxy.
        secret: of ``rosauth``, whose ``auth`` operation is then the first of each connection.

    Raises:
        ValidationError: an unusable file or header, or a secret without TLS, which anyone could overhear.
    """

    tls: bool | str = False
    headers: Mapping[str, str] = field(default_factory=dict)
    secret: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        for name, value in mapping("headers", self.headers).items():
            text(f"headers[{name!r}]", value)
        if not isinstance(self.tls, bool | str):
            raise ValidationError(f"tls must be true, false or the path of a PEM file, not {shown(self.tls)}.")
        if not self.tls and (self.secret or self.headers):
            raise ValidationError("tls must be given with headers or a secret; on an open connection they can be read.")
        self.context()

    def context(self) -> ssl.SSLContext | None:
        """Return the TLS context, None without TLS."""
        if not self.tls:
            return None
        try:
            return ssl.create_default_context(cafile=self.tls if isinstance(self.tls, str) else None)
        except (OSError, ssl.SSLError) as exc:
            raise ValidationError(
                f"tls must be a readable PEM file of authorities, not {shown(self.tls)}: {exc}"
            ) from exc

    def login(self, host: str) -> str | None:
        """Return the ``auth`` operation of rosauth, None without a secret."""
        if not self.secret:
            return None
        now = int(time.time())
        said = {
            "client": "strands-robots",
            "dest": host,
            "rand": token_hex(8),
            "t": now,
            "level": "user",
            "end": now + 60,
        }
        mac = sha512("".join([self.secret, *map(str, said.values())]).encode()).hexdigest()
        return encoded("auth", mac=mac, **said)


class RosbridgeSession:
    """One WebSocket, reopened when it is lost; its frames arrive on one thread.

    The first attempt has to succeed; later ones go on until :meth:`close`.

    Args:
        opened: called on the session's thread with each new connection's sender, before any other frame is sent.
        received: called there with every frame.
        lost: called there with the reason whenever a connection ends.
        tick: called there about once in :data:`TICK_S` while there is a connection.
        access: how to reach a server that is not open.

    Raises:
        ValidationError: ``host`` is no bare hostname or address, or ``tcp_port`` none from 1 to 65535.
    """

    def __init__(
        self,
        host: str,
        tcp_port: int,
        *,
        connect_s: float,
        opened: Callable[[Callable[[str], None]], None],
        received: Callable[[str | bytes], None],
        lost: Callable[[str], None],
        tick: Callable[[], None] = lambda: None,
        access: RosbridgeAccess | None = None,
    ) -> None:
        self._access = access or RosbridgeAccess()
        reason = dial_host_error(host)
        if reason is not None:
            raise ValidationError(reason)
        bare = f"[{host}]" if ":" in host and not host.startswith("[") else host
        self.url = f"{'wss' if self._access.tls else 'ws'}://{bare}:{port('port', tcp_port)}"
        self._host = host
        self._connect_s = connect_s
        self._opened, self._received, self._lost, self._tick = opened, received, lost, tick
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._thread: threading.Thread | None = None
        self._socket: Any = None
        self._settled = threading.Event()
        self._closing = threading.Event()
        self._why = "not connected"

    @property
    def up(self) -> bool:
        """True while there is a connection."""
        return self._socket is not None

    def start(self) -> None:
        """Begin to connect when nothing was connected yet, and return."""
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                return
            client = optional_module("websockets.sync.client", what="A rosbridge connection", extra="rosbridge")
            self._settled = threading.Event()
            self._closing = threading.Event()
            self._thread = threading.Thread(
                target=self._run, args=(client, self._settled, self._closing), name="rosbridge", daemon=True
            )
            self._thread.start()

    def cut(self) -> None:
        """Drop the connection and all that it has not sent; then reconnect.

        A blocked :meth:`send` fails, and nothing stale arrives.
        """
        socket = self._socket
        if socket is not None:
            with contextlib.suppress(OSError):  # it broke meanwhile, which is what the caller wants
                socket.socket.setsockopt(SOL_SOCKET, SO_LINGER, struct.pack("ii", 1, 0))
                socket.socket.shutdown(SHUT_RDWR)

    def open(self) -> None:
        """Connect at the first call; :class:`RosError` while there is no connection."""
        self._current()

    def send(self, frame: str) -> None:
        """Send one frame, connecting first when nothing was connected yet.

        Raises:
            RosError: no connection, or it broke. A lost one is being reopened meanwhile; nothing is queued for it.
        """
        self._send(self._current(), frame)

    def send_if_free(self, frame: str) -> bool:
        """Send one frame unless another is being sent: a question can wait, and must not."""
        socket = self._socket
        if socket is None or not self._writing.acquire(blocking=False):
            return False
        try:
            socket.send(frame)
        finally:
            self._writing.release()
        return True

    def confirm(self, within_s: float) -> None:
        """Wait until the server has received all that was sent, by a WebSocket ping.

        Raises:
            NoReceiptError: it did not confirm in time, or the connection broke.
        """
        socket = self._socket
        arrived = False
        if socket is not None:
            with contextlib.suppress(Exception):  # whatever breaks a connection, there is no receipt
                arrived = socket.ping().wait(within_s)
        if not arrived or self._socket is not socket:
            raise NoReceiptError(f"rosbridge at {self.url} did not confirm within {within_s:g} s; is the server gone?")

    def close(self) -> None:
        """Close the connection and end the thread. A later :meth:`send` opens anew."""
        with self._lock:
            thread, self._thread = self._thread, None
            self._closing.set()
            socket = self._socket
        if socket is not None:
            # The closing handshake is a write, which a clogged connection does not take.
            if self._writing.acquire(timeout=_CLOSE_S):
                self._writing.release()
            else:
                self.cut()
            socket.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join(self._connect_s + 2 * _CLOSE_S)

    def _current(self) -> Any:
        self.start()
        if not self._settled.wait(self._connect_s + _CLOSE_S):
            raise RosError(f"No rosbridge server answers at {self.url} within {self._connect_s:g} s.")
        socket = self._socket
        if socket is None:
            raise RosError(f"No connection to rosbridge at {self.url}: {self._why}.")
        return socket

    def _run(self, client: Any, settled: threading.Event, closing: threading.Event) -> None:
        pause = BACKOFF_S[0]
        while not closing.is_set():
            try:
                with client.connect(
                    self.url,
                    open_timeout=self._connect_s,
                    close_timeout=_CLOSE_S,
                    ping_interval=_PING_S,
                    ping_timeout=_PING_S,
                    compression=None,
                    proxy=None,
                    max_size=FRAME_MAX,
                    ssl=self._access.context(),
                    additional_headers=dict(self._access.headers) or None,
                ) as socket:
                    login = self._access.login(self._host)
                    if login is not None:
                        self._send(socket, login)
                    self._opened(partial(self._send, socket))
                    self._socket = socket
                    settled.set()
                    pause = BACKOFF_S[0]
                    # A close during the steps above must not leave a connection open.
                    if closing.is_set():
                        return
                    self._receive(socket)
            except Exception as exc:  # noqa: BLE001 - whatever ends a connection is reported, and the next attempt follows
                self._why = str(exc) or type(exc).__name__
            finally:
                self._socket = None
                self._lost(self._why)
            first = not settled.is_set()
            settled.set()
            if first or closing.wait(pause):
                return
            pause = min(2 * pause, BACKOFF_S[1])
            logger.info("Reconnecting to %s: %s", self.url, self._why)

    def _receive(self, socket: Any) -> None:
        """Hand on the frames of a connection until it ends, which raises."""
        due = time.monotonic() + TICK_S
        while True:
            with contextlib.suppress(TimeoutError):
                self._received(socket.recv(timeout=max(0.0, due - time.monotonic())))
            if time.monotonic() >= due:
                self._tick()
                due = time.monotonic() + TICK_S

    def _send(self, socket: Any, frame: str) -> None:
        try:
            with self._writing:
                socket.send(frame)
        except Exception as exc:
            raise RosError(f"The connection to rosbridge at {self.url} broke: {exc}") from exc


class UrgentConnection:
    """A second connection, for zeros alone, opened ahead of need.

    Args:
        host: of the server, with its ``port``.
        connect_s: how long one attempt to connect may take, in seconds.
        access: how to reach a server that is not open.
    """

    def __init__(self, host: str, port: int, connect_s: float, access: RosbridgeAccess | None = None) -> None:
        self._session = RosbridgeSession(
            host,
            port,
            connect_s=connect_s,
            opened=self._opened,
            received=self._received,
            lost=self._lost,
            access=access,
        )
        self._numbers = count(1)
        self._kinds: dict[str, str] = {}
        self._complaint = ""

    def prepare(self, topic: str, kind: str) -> None:
        """Start the connection and advertise the topic, without waiting."""
        known = self._kinds.get(topic) == kind
        self._kinds[topic] = kind
        if self._session.up:
            if not known:
                self._session.send(self._advertised(topic, kind))
        else:
            self._session.start()

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        """Send one message now, and return once the server has received it.

        Raises:
            NoReceiptError: it did not confirm within :data:`CONFIRM_S`: it may be gone.
            RosError: there is no connection yet; nothing is waited for.
        """
        complaint, self._complaint = self._complaint, ""
        if complaint:
            raise RosError(complaint)
        self.prepare(topic, kind)
        if not self._session.up:
            raise RosError(f"The second connection to {self._session.url} is not there.")
        self._session.send(encoded("publish", id=f"publish:{next(self._numbers)}", topic=topic, type=kind, msg=fields))
        self._session.confirm(CONFIRM_S)

    def close(self) -> None:
        """Close the connection."""
        self._kinds.clear()
        self._session.close()

    def _advertised(self, topic: str, kind: str) -> str:
        return encoded("advertise", id=f"advertise:{next(self._numbers)}", topic=topic, type=kind)

    # On the session's thread.

    def _opened(self, send: Callable[[str], None]) -> None:
        for topic, kind in list(self._kinds.items()):
            send(self._advertised(topic, kind))

    def _received(self, frame: str | bytes) -> None:
        try:
            message = decoded(frame)
        except RosError as exc:
            logger.warning("%s sent what cannot be used: %s", self._session.url, exc)
            return
        if message["op"] == "status" and message.get("level") == "error":
            self._complaint = f"rosbridge says: {shown(message.get('msg'))}"
            logger.warning("%s", self._complaint)

    def _lost(self, why: str) -> None:
        logger.info("The second connection to %s was lost: %s", self._session.url, why)
