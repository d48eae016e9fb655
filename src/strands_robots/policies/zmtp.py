"""Requests to a ZeroMQ server, over a socket of our own.

ZeroMQ's own library bounds each part of a message and not their number, so a server could fill the memory. Here an
answer is bounded as a whole. Wire: ZMTP 3.0 (ZeroMQ RFC 23) with the mechanism NULL and the socket type REQ: a greeting
and a READY command from either side, then each message as an empty frame and its body.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from urllib.parse import urlsplit

from strands_robots.errors import StrandsRobotsError

_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
_VERSION = 10
"""Place of the version in a greeting, behind the signature."""
_READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
_PING, _PONG = b"\x04PING", b"\x04PONG"
_MORE, _LONG, _COMMAND = 1, 2, 4
_COMMAND_MAX = 4096
_PIECE = 64 * 1024


class ZmtpError(StrandsRobotsError):
    """The server speaks something else, or its answer is too long."""


class RequestSocket:
    """Connection that is opened with the first request; used by one thread at a time.

    Args:
        url: ``tcp://HOST:PORT``.
        answer_max: longest answer, in bytes.
    """

    def __init__(self, url: str, answer_max: int) -> None:
        self._url = url
        self._answer_max = answer_max
        self._socket: socket.socket | None = None
        self._received = bytearray()
        self._delimited = False

    def send(self, body: bytes, deadline: float) -> None:
        """Send a request; ``deadline`` in monotonic seconds.

        Raises:
            OSError: no server is there, or it does not read in time.
        """
        if self._socket is None:
            self._open(deadline)
        self._write(_frame(_MORE, b"") + _frame(0, body), deadline)

    def receive(self, seconds: float) -> bytes:
        """Return the answer.

        Raises:
            TimeoutError: it is not whole in time; another call goes on with it.
            OSError: the connection was lost.
            ZmtpError: the answer is longer than it may be, or none of ZeroMQ's.
        """
        deadline = time.monotonic() + seconds
        while True:
            flags, body = self._next_frame(deadline)
            if flags & _COMMAND:
                if body.startswith(_PING):
                    # Behind the name come two bytes of a lifetime, and a context to be sent back.
                    self._write(_frame(_COMMAND, _PONG + body[len(_PING) + 2 :]), deadline)
            elif not flags & _MORE:
                self._delimited = False
                return body
            elif body or self._delimited:
                raise ZmtpError("it sent an answer of several parts")
            else:
                self._delimited = True

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        opened, self._socket = self._socket, None
        self._received.clear()
        self._delimited = False
        if opened is not None:
            with contextlib.suppress(OSError):  # it is lost already
                opened.close()

    def _open(self, deadline: float) -> None:
        address = urlsplit(self._url)
        self._socket = socket.create_connection((str(address.hostname), address.port or 0), _left(deadline))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._write(_GREETING, deadline)
        self._fill(len(_GREETING), deadline)
        greeting = self._taken(len(_GREETING))
        if greeting[0] != 0xFF or not greeting[_VERSION - 1] & 1 or greeting[_VERSION] < 3:
            raise ZmtpError("it speaks no ZMTP 3")
        self._write(_frame(_COMMAND, _READY), deadline)
        # A message before the server's own READY would end the connection.
        flags, body = self._next_frame(deadline)
        if not flags & _COMMAND or not body.startswith(_READY[:6]):
            raise ZmtpError("it is not ready")

    def _next_frame(self, deadline: float) -> tuple[int, bytes]:
        """Return the flags and the body of the next frame, once it is whole."""
        self._fill(2, deadline)
        flags, length, start = self._received[0], self._received[1], 2
        if flags & _LONG:
            start = 9
            self._fill(start, deadline)
            (length,) = struct.unpack_from(">Q", self._received, 1)
        most = _COMMAND_MAX if flags & _COMMAND else self._answer_max
        if length > most:
            raise ZmtpError(f"it sent {length:,} bytes, and may send {most:,}")
        self._fill(start + length, deadline)
        return flags, self._taken(start + length)[start:]

    def _fill(self, size: int, deadline: float) -> None:
        """Read until so many bytes wait; what came in time stays for the next call."""
        assert self._socket is not None
        while len(self._received) < size:
            if time.monotonic() > deadline:
                raise TimeoutError("it did not answer in time")
            self._socket.settimeout(_left(deadline))
            data = self._socket.recv(_PIECE)
            if not data:
                raise ConnectionResetError("it hung up")
            self._received += data

    def _taken(self, size: int) -> bytes:
        taken = bytes(memoryview(self._received)[:size])
        del self._received[:size]
        return taken

    def _write(self, data: bytes, deadline: float) -> None:
        assert self._socket is not None
        self._socket.settimeout(_left(deadline))
        self._socket.sendall(data)


def _frame(flags: int, body: bytes) -> bytes:
    if len(body) > 255:
        return bytes([flags | _LONG]) + struct.pack(">Q", len(body)) + body
    return bytes([flags, len(body)]) + body


def _left(deadline: float) -> float:
    return max(0.001, deadline - time.monotonic())
