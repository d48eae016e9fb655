"""Policy servers that send a byte at a time, never read, or never end an answer: each step has its deadline."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import itertools
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from strands_robots.policies.groot import GrootPolicy, RequestSocket, ZmtpError
from strands_robots.policies.openpi import OpenPiPolicy
from strands_robots.policies.policy_server import PolicyServerError, ServerSocket
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.policies.remote import RemotePolicy

KEYS = ("a", "b")
DEADLINE_S = 0.3
PATIENCE_S = 20.0
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06ROUTER"
MIB = 2**20


@contextmanager
def serving(attend: Callable[[socket.socket], object]) -> Iterator[int]:
    """A TCP server that treats each connection so."""
    listening = socket.create_server(("127.0.0.1", 0))
    opened: list[socket.socket] = []

    def run() -> None:
        with contextlib.suppress(OSError):  # closed, or the robot hung up
            while True:
                connection, _ = listening.accept()
                opened.append(connection)
                threading.Thread(target=quietly, args=(connection,), daemon=True).start()

    def quietly(connection: socket.socket) -> None:
        with contextlib.suppress(OSError):
            attend(connection)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield listening.getsockname()[1]
    finally:
        for each in (listening, *opened):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        thread.join(PATIENCE_S)


def silent(connection: socket.socket) -> None:
    connection.recv(MIB)


def trickling(connection: socket.socket) -> None:
    connection.recv(MIB)
    for byte in itertools.cycle(b"HTTP/1.1 101 Switching Protocols\r\nX-Slow: " + b"y" * 4000):
        connection.sendall(bytes([byte]))
        time.sleep(0.02)


def garbage(connection: socket.socket) -> None:
    while True:
        connection.sendall(b"\xff" * 65536)


def hanging_up(connection: socket.socket) -> None:
    connection.close()


def openpi(port: int) -> None:
    profile = Profile("p", "openpi", KEYS, KEYS, url=f"ws://127.0.0.1:{port}", first_deadline_s=DEADLINE_S)
    OpenPiPolicy(profile).reset("wave", {})


def groot(port: int) -> None:
    url = f"tcp://127.0.0.1:{port}"
    profile = Profile("p", "groot", KEYS, KEYS, url=url, parts={"arm": KEYS}, first_deadline_s=DEADLINE_S)
    GrootPolicy(profile).reset("wave", {})


def remote(port: int) -> None:
    RemotePolicy(policy_port=port, reset_deadline_s=DEADLINE_S).reset("wave", {})


# A thread of the library may write to a connection that it has closed because of the garbage.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("ask", [openpi, groot, remote])
@pytest.mark.parametrize("attend", [silent, trickling, garbage, hanging_up])
def test_a_server_that_never_gets_ready_is_given_up(
    ask: Callable[[int], None], attend: Callable[[socket.socket], object]
) -> None:
    with serving(attend) as port:
        began = time.monotonic()
        with pytest.raises(PolicyServerError):
            ask(port)
        assert time.monotonic() - began < PATIENCE_S


def switched(connection: socket.socket) -> None:
    """Answer the handshake of a WebSocket."""
    request = b""
    while b"\r\n\r\n" not in request:
        request += connection.recv(4096)
    (key,) = [each.split(b": ")[1] for each in request.split(b"\r\n") if each.lower().startswith(b"sec-websocket-key")]
    accept = base64.b64encode(hashlib.sha1(key + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11").digest())
    connection.sendall(
        b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: "
        + accept
        + b"\r\n\r\n"
    )


def test_a_server_that_never_reads_does_not_keep_an_observation_or_its_own_end() -> None:
    ended = threading.Event()

    def attend(connection: socket.socket) -> None:
        switched(connection)
        connection.sendall(b"\x82\x01\x80")
        ended.wait(60)

    with serving(attend) as port:
        cameras = (CameraMap("front", "front", size=(2000, 2000)),)
        url = f"ws://127.0.0.1:{port}"
        profile = Profile("p", "openpi", KEYS, KEYS, url=url, cameras=cameras, first_deadline_s=DEADLINE_S)
        began = time.monotonic()
        with pytest.raises(PolicyServerError):
            OpenPiPolicy(profile).reset("wave", {})
        ended.set()
        assert time.monotonic() - began < PATIENCE_S


def test_pings_that_nobody_reads_the_answers_of_do_not_keep_a_connection_open() -> None:
    def attend(connection: socket.socket) -> None:
        switched(connection)
        while True:
            connection.sendall((b"\x89\x7d" + bytes(125)) * 500)

    with serving(attend) as port:
        connection = ServerSocket(f"ws://127.0.0.1:{port}")
        connection.open(time.monotonic() + 5)
        with pytest.raises((TimeoutError, *connection.lost)):
            connection.receive(DEADLINE_S)
        began = time.monotonic()
        connection.close()
        assert time.monotonic() - began < PATIENCE_S


def ready(answer: Callable[[socket.socket], object]) -> Callable[[socket.socket], None]:
    """A server of ZeroMQ that is ready, and answers the first request so."""

    def attend(connection: socket.socket) -> None:
        connection.sendall(GREETING)
        connection.recv(64, socket.MSG_WAITALL)
        connection.sendall(READY)
        for command_or_request in (27, 9):
            connection.recv(command_or_request, socket.MSG_WAITALL)
        answer(connection)
        connection.recv(4096)

    return attend


def part(flags: int, body: bytes) -> bytes:
    return bytes([flags | 2]) + struct.pack(">Q", len(body)) + body


def endless_parts(connection: socket.socket) -> None:
    connection.sendall(b"\x01\x00")
    while True:
        connection.sendall(part(1, bytes(MIB)))


def delimiters(connection: socket.socket) -> None:
    while True:
        connection.sendall(b"\x01\x00" * 1000)


def a_long_answer(connection: socket.socket) -> None:
    connection.sendall(b"\x01\x00" + b"\x02" + struct.pack(">Q", 24 * MIB))
    while True:
        connection.sendall(bytes(MIB))


def a_long_command(connection: socket.socket) -> None:
    connection.sendall(b"\x06" + struct.pack(">Q", 8192) + bytes(8192))


def memory_mb() -> float:
    (line,) = [each for each in Path("/proc/self/status").read_text().splitlines() if each.startswith("VmRSS")]
    return int(line.split()[1]) / 1024


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (endless_parts, "several parts"),
        (delimiters, "several parts"),
        (a_long_answer, "25,165,824 bytes, and may send 1,048,576"),
        (a_long_command, "8,192 bytes, and may send 4,096"),
    ],
)
def test_an_answer_of_zeromq_is_bounded_as_a_whole(answer: Callable[[socket.socket], object], words: str) -> None:
    with serving(ready(answer)) as port:
        connection = RequestSocket(f"tcp://127.0.0.1:{port}", MIB)
        before = memory_mb()
        connection.send(b"hello", time.monotonic() + PATIENCE_S)
        with pytest.raises(ZmtpError, match=words):
            connection.receive(PATIENCE_S)
        assert memory_mb() - before < 50
        connection.close()


def test_an_answer_that_trickles_in_is_gone_on_with_and_a_ping_is_answered() -> None:
    heard: list[bytes] = []

    def answer(connection: socket.socket) -> None:
        connection.sendall(b"\x04\x09\x04PING\x00\x10hi")
        heard.append(connection.recv(4096))
        for byte in b"\x01\x00\x00\x05world":
            connection.sendall(bytes([byte]))
            time.sleep(0.02)

    with serving(ready(answer)) as port:
        connection = RequestSocket(f"tcp://127.0.0.1:{port}", MIB)
        connection.send(b"hello", time.monotonic() + PATIENCE_S)
        found, tries, end = b"", 0, time.monotonic() + PATIENCE_S
        while not found and time.monotonic() < end:
            tries += 1
            with contextlib.suppress(TimeoutError):
                found = connection.receive(0.03)
        assert (found, heard) == (b"world", [b"\x04\x07\x04PONGhi"])
        assert tries > 1
        connection.close()
