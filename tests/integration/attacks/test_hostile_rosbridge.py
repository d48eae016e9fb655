"""A rosbridge server that floods and lies beside one robot: it halts, and what it says is bounded."""

from __future__ import annotations

import threading
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
