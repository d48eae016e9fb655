"""A rosbridge server that floods, lies and hangs beside one robot: it halts, and what it says is bounded."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from fixtures.ros_bases import OPEN
from fixtures.rosbridge_server import RosbridgeServer
from fixtures.waiting import eventually

from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot

LIES = ["", "[]", '{"op": 7}', '{"op": "publish", "topic": "/odom", "msg": {"twist": {"twist": "fast"}}}']


@pytest.fixture
def server() -> Iterator[RosbridgeServer]:
    served = RosbridgeServer()
    served.on_publish = lambda topic, twist: served.tell("/odom", {"twist": {"twist": twist}})
    served.start()
    yield served
    served.stop()


@pytest.fixture
def rover(server: RosbridgeServer) -> Iterator[RosbridgeRobot]:
    robot = RosbridgeRobot("rover", "/cmd_vel", "/odom", host="127.0.0.1", port=server.port, command_gate=OPEN)
    yield robot
    robot.disconnect()


def test_base_halts_while_its_server_floods_it_with_lies(server: RosbridgeServer, rover: RosbridgeRobot) -> None:
    assert rover.start_drive(0.5, 0.0, 30.0)["status"] == "success"
    eventually(lambda: server.published and server.published[-1][1]["linear"]["x"] == 0.5)
    ended, sent = threading.Event(), [0]

    def flood() -> None:
        while not ended.is_set():
            sent[0] += server.send(LIES[sent[0] % len(LIES)])

    flooder = threading.Thread(target=flood)
    flooder.start()
    try:
        eventually(lambda: sent[0] > 2000)
        rover.halt("test")
        eventually(lambda: not server.published[-1][1]["linear"]["x"], what="a zero at the base")
    finally:
        ended.set()
        flooder.join(20)
    assert not flooder.is_alive()
    eventually(lambda: rover.halt("after the flood").stopped)


class Relay:
    """A way to the server that can hang: it accepts, and passes nothing on until it is thawed."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._open = threading.Event()
        self._open.set()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._sockets = [self._listening]
        self._run(self._accept)

    def freeze(self) -> None:
        self._open.clear()

    def thaw(self) -> None:
        self._open.set()

    def close(self) -> None:
        self.thaw()
        for each in self._sockets:
            with contextlib.suppress(OSError):  # its other end is gone
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _run(self, work: object, *arguments: object) -> None:
        threading.Thread(target=work, args=arguments, daemon=True).start()  # type: ignore[arg-type]

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                robot, _ = self._listening.accept()
                server = socket.create_connection(("127.0.0.1", self._target))
                self._sockets += [robot, server]
                self._run(self._pump, robot, server)
                self._run(self._pump, server, robot)

    def _pump(self, one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):  # one end hung up
            while data := one.recv(65536):
                self._open.wait()
                other.sendall(data)
            other.shutdown(socket.SHUT_WR)


def test_base_whose_server_hangs_is_not_said_to_have_stopped_and_is_halted_when_it_answers(
    server: RosbridgeServer,
) -> None:
    relay = Relay(server.port)
    rover = RosbridgeRobot("rover", "/cmd_vel", "/odom", host="127.0.0.1", port=relay.port, command_gate=OPEN)
    try:
        assert rover.start_drive(0.5, 0.0, 30.0)["status"] == "success"
        eventually(lambda: server.published and server.published[-1][1]["linear"]["x"] == 0.5)
        relay.freeze()
        began = time.monotonic()
        verdict = rover.halt("test")
        assert verdict.stopped is not True, verdict
        assert time.monotonic() - began < 30.0, "before the drive's own time was over"
        assert server.published[-1][1]["linear"]["x"] == 0.5, "nothing came through"
        relay.thaw()
        eventually(lambda: not server.published[-1][1]["linear"]["x"], what="a zero at the base")
        eventually(lambda: rover.halt("when it answers").stopped)
    finally:
        relay.close()
        rover.disconnect()
