"""A real leader arm and a real follower that are two peers of the mesh."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus, arm_servos
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, fleet

from strands_robots.hardware import DeviceBody
from strands_robots.hardware.lerobot_device import make_device
from strands_robots.mesh.input import InputPublisher, InputReceiver

pytestmark = pytest.mark.system


class Hand:
    """Moves the first servo of a leader arm to and fro, a few degrees, until it is let go."""

    def __init__(self, bus: FeetechBus) -> None:
        self._servo = bus.servos[1]
        self._middle = self._servo.shaft
        self._gone = threading.Event()
        self._thread = threading.Thread(target=self._wave, daemon=True)

    def __enter__(self) -> Hand:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._gone.set()
        self._thread.join()

    def _wave(self) -> None:
        began = time.monotonic()
        while not self._gone.wait(0.01):
            self._servo.shaft = self._middle + 200 * math.sin((time.monotonic() - began) * math.tau / 2)


@pytest.fixture
def peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_DIR", str(tmp_path / "audit"))
    with fleet(tmp_path) as joined:
        joined.clock = time.time  # type: ignore[assignment]  # these peers live in real time
        yield joined


@pytest.fixture
def leading(tmp_path: Path, calibration: Path) -> Iterator[tuple[FeetechBus, Any]]:
    with FeetechBus(arm_servos(), link=tmp_path / "leader") as bus:
        options = {"port": bus.port, "calibration": calibration, "calibration_dir": tmp_path / "lerobot"}
        leader = make_device("so101", options, "leader")
        DeviceBody.bring_up(leader)
        yield bus, leader
        leader.disconnect()


def test_the_follower_mirrors_the_leader_until_the_lockout(
    arm: Callable[..., Any], bus: FeetechBus, leading: tuple[FeetechBus, Any], peers: Fleet
) -> None:
    hand, leader = leading
    robot = arm()
    follower, lead = peers.join(robot, "follower"), peers.join(Arm(), "lead")
    publisher, receiver = InputPublisher(lead, leader), InputReceiver(follower, robot, "lead")
    receiver.start()
    assert receiver.start_refusal is None
    publisher.start()
    try:
        with Hand(hand):
            eventually(lambda: receiver.stats["frames_received"] >= 100, what="two seconds of frames")
            assert len({write.data for write in bus.written_after(0.0) if write.servo == 1}) > 20
            follower.emergency_stop()
            at = time.monotonic()
            eventually(lambda: receiver.stats["rejected_lockout"] > 0)
            time.sleep(0.2)
        assert [write for write in bus.writes if write.at > at] == []
        assert all(servo.torque for servo in bus.servos.values())
    finally:
        sent = publisher.stop()
        told = receiver.stop()
    assert sent["errors"] == 0, sent
    assert told["errors"] == 0, told
    assert told["out_of_order"] == 0
    assert told["running"] is False
