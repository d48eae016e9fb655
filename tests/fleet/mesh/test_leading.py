"""A follower of this machine with a leader on the mesh."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.devices import RecordingDevice

from strands_robots.fleet.mesh.leading import LimitedFollower, await_peer
from strands_robots.hardware import HardwareRobot
from strands_robots.mesh.transport import zenoh_config
from strands_robots.mesh.transport.zenoh_config import Posture
from strands_robots.utils import ValidationError


@pytest.mark.parametrize("stated", ["ZENOH_LISTEN", "ZENOH_CONNECT"])
def test_peer_is_awaited_longer_than_its_link_may_pause(monkeypatch: pytest.MonkeyPatch, stated: str) -> None:
    waited: list[float] = []

    def wait(mesh: object, peer: str, timeout: float) -> bool:
        waited.append(timeout)
        return True

    monkeypatch.setattr("strands_robots.mesh.core.wait_for_peer", wait)
    mesh: Any = None
    await_peer(mesh, "arm-1")
    monkeypatch.setenv(stated, "tcp/127.0.0.1:7447")
    await_peer(mesh, "arm-1")
    retry = zenoh_config.explicit(Posture.from_settings())["connect"]["retry"]
    assert waited[0] < retry["period_max_ms"] / 1000 < waited[1]


def test_first_frames_and_a_pause_do_not_make_the_follower_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    device = RecordingDevice()
    robot = HardwareRobot(device, "arm")
    robot.connect()
    clock = iter([0.0, 0.02, 0.04, 60.0])
    follow = LimitedFollower(robot.body(), 1.0, now=lambda: next(clock))
    applied: list[float] = []
    monkeypatch.setattr(robot, "send_action", lambda action: applied.append(action["pan.pos"]))
    for _ in range(3):
        follow(robot, {"pan.pos": 90.0})
    # From 10, at one range of 200 a second: 4 in each 20 ms, and 8 after a minute's pause.
    assert applied == pytest.approx([14.0, 18.0, 26.0])
    with pytest.raises(ValidationError, match="elbow"):
        follow(robot, {"elbow": 1.0})
    robot.cleanup()
