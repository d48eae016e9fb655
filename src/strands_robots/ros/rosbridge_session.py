"""One WebSocket to a rosbridge server, reopened when it is lost: frames out, frames in, on one thread."""

from __future__ import annotations

import contextlib
import logging
import struct
import threading
from collections.abc import Callable
from functools import partial
from socket import SHUT_RDWR, SO_LINGER, SOL_SOCKET
from typing import Any

from strands_robots.ros.link import RosError
from strands_robots.ros.rosbridge_wire import FRAME_MAX
from strands_robots.utils import ValidationError, dial_host_error, missing_extra, port

logger = logging.getLogger(__name__)

BACKOFF_S = (0.1, 2.0)
"""First and longest pause between two attempts to reopen a lost connection."""

_PING_S = 2.0
_CLOSE_S = 0.5


class Session:
    """Keeps one connection. The first attempt has to succeed; later ones go on until :meth:`close`.

    Args:
        opened: called on the session's thread with each new connection's sender, before anybody else may send.
        received: called there with every frame.
        lost: called there with the reason whenever a connection ends.

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
    ) -> None:
        reason = dial_host_error(host)
        if reason is not None:
            raise ValidationError(reason)
        bare = f"[{host}]" if ":" in host and not host.startswith("[") else host
        self.url = f"ws://{bare}:{port('port', tcp_port)}"
        self._connect_s = connect_s
        self._opened, self._received, self._lost = opened, received, lost
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._thread: threading.Thread | None = None
        self._socket: Any = None
        self._settled = threading.Event()
        self._closing = threading.Event()
        self._why = "not connected"

    @property
    def up(self) -> bool:
        """A connection stands."""
        return self._socket is not None

    def start(self) -> None:
        """Begin to connect when nothing was connected yet, and return."""
        self._start()

    def cut(self) -> None:
        """Drop the connection with what it holds unsent: a blocked :meth:`send` fails, and nothing stale arrives.

        A new one is made as after any loss.
        """
        socket = self._socket
        if socket is not None:
            with contextlib.suppress(OSError):  # it broke meanwhile, which is what was asked for
                socket.socket.setsockopt(SOL_SOCKET, SO_LINGER, struct.pack("ii", 1, 0))
                socket.socket.shutdown(SHUT_RDWR)

    def open(self) -> None:
        """Connect when nothing was connected yet. Raises :class:`RosError` while there is no connection."""
        self._current()

    def send(self, frame: str) -> None:
        """Send one frame, connecting first when nothing was connected yet.

        Raises:
            RosError: no connection, or it broke. A lost one is being reopened meanwhile; nothing is queued for it.
        """
        self._send(self._current(), frame)

    def close(self) -> None:
        """Close the connection and end the thread. A later :meth:`send` opens anew."""
        with self._lock:
            thread, self._thread = self._thread, None
            self._closing.set()
            socket = self._socket
        if socket is not None:
            # Saying goodbye needs the turn of a write, which a clogged connection does not give.
            if self._writing.acquire(timeout=_CLOSE_S):
                self._writing.release()
            else:
                self.cut()
            socket.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join(self._connect_s + 2 * _CLOSE_S)

    def _current(self) -> Any:
        self._start()
        if not self._settled.wait(self._connect_s + _CLOSE_S):
            raise RosError(f"No rosbridge server answers at {self.url} within {self._connect_s:g} s.")
        socket = self._socket
        if socket is None:
            raise RosError(f"No connection to rosbridge at {self.url}: {self._why}.")
        return socket

    def _start(self) -> None:
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                return
            client = _websockets_client()
            self._settled = threading.Event()
            self._closing = threading.Event()
            self._thread = threading.Thread(
                target=self._run, args=(client, self._settled, self._closing), name="rosbridge", daemon=True
            )
            self._thread.start()

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
                ) as socket:
                    self._opened(partial(self._send, socket))
                    self._socket = socket
                    settled.set()
                    pause = BACKOFF_S[0]
                    # A close that came between two steps of this one must not leave a connection behind.
                    if closing.is_set():
                        return
                    for frame in socket:
                        self._received(frame)
                    self._why = "the server closed it"
            except Exception as exc:  # noqa: BLE001 - whatever ends a connection is told, and the next one is tried
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

    def _send(self, socket: Any, frame: str) -> None:
        try:
            with self._writing:
                socket.send(frame)
        except Exception as exc:
            raise RosError(f"The connection to rosbridge at {self.url} broke: {exc}") from exc


def _websockets_client() -> Any:
    try:
        from websockets.sync import client  # noqa: PLC0415 - loaded when a connection is asked for
    except ModuleNotFoundError as exc:
        if (exc.name or "").partition(".")[0] != "websockets":
            raise
        raise missing_extra("A rosbridge connection", "rosbridge") from exc
    return client
