"""WebSocket to a policy server, with deadlines and a bound on frames."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from strands_robots.policies.decoding import MESSAGE_MAX
from strands_robots.policies.policy_server import PolicyServerError
from strands_robots.utils import optional_module

_module = partial(optional_module, what="A policy server on a WebSocket", extra="remote")

_CLOSE_S = 0.5
_FRAMES_MAX = 2
"""Frames that wait unread; with more the server has to wait."""

_TOO_BIG = 1009


class ServerSocket:
    """Connection that is opened anew after it was lost; used by one thread at a time.

    Args:
        url: ``ws://`` or ``wss://``.
        headers: sent with the handshake.

    Raises:
        MissingExtraError: the [remote] extra is not installed.
    """

    def __init__(self, url: str, headers: Mapping[str, str] | None = None) -> None:
        self._url = url
        self._headers = dict(headers or {})
        self._client = _module("websockets.sync.client")
        self._errors = _module("websockets.exceptions")
        self._socket: Any = None
        self._open_socket = contextlib.ExitStack()
        # Where garbage arrives during the handshake, an assertion of websockets may fail.
        self.lost: tuple[type[Exception], ...] = (self._errors.WebSocketException, OSError, AssertionError)
        """Raised where the connection, or its opening, failed."""

    @property
    def is_open(self) -> bool:
        """Tell whether it was opened and not closed; a lost one counts as open."""
        return self._socket is not None

    def open(self, deadline: float) -> None:
        """Connect anew; ``deadline`` in monotonic seconds."""
        self.close()
        # Without extensions nothing is unpacked: what a frame says of its length holds.
        opening = self._client.connect(
            self._url,
            additional_headers=self._headers,
            open_timeout=_left(deadline),
            close_timeout=_CLOSE_S,
            ping_interval=None,
            compression=None,
            proxy=None,
            max_size=MESSAGE_MAX,
            max_queue=_FRAMES_MAX,
        )
        self._socket = self._open_socket.enter_context(opening)
        self._bound_writes(deadline)

    def send(self, frame: str | bytes, deadline: float) -> None:
        """Send a frame; a server that does not read it in time loses the connection."""
        if self._socket is None:
            raise ConnectionError("not connected")
        self._bound_writes(deadline)
        self._socket.send(frame)

    def receive(self, seconds: float) -> str | bytes:
        """Return the next frame.

        Raises:
            TimeoutError: none came in time.
            PolicyServerError: it is longer than MESSAGE_MAX.
        """
        try:
            frame: str | bytes = self._socket.recv(timeout=seconds)
        except self._errors.ConnectionClosed as exc:
            if exc.sent is not None and exc.sent.code == _TOO_BIG:
                raise PolicyServerError(
                    f"the policy server at {self._url} sent a frame of more than {MESSAGE_MAX:,} bytes"
                ) from exc
            raise
        return frame

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        self._socket = None
        with contextlib.suppress(*self.lost):  # a lost connection is closed already
            self._open_socket.close()

    def _bound_writes(self, deadline: float) -> None:
        # A blocked write, a pong's too, would keep the connection locked, and close() would wait for it.
        self._socket.socket.settimeout(_left(deadline))


def _left(deadline: float) -> float:
    return max(0.01, deadline - time.monotonic())
