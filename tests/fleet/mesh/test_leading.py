"""A follower of this machine with a leader on the mesh."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import RecordingDevice

from strands_robots.errors import RobotError
from strands_robots.fleet.mesh.leading import LedPeer, LimitedFollower, RemoteFollower, await_peer
from strands_robots.hardware import HardwareRobot
from strands_robots.mesh.transport import config
from strands_robots.mesh.transport.config import Posture
from strands_robots.teleoperators import LeaderPolicy
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
    retry = config.explicit(Posture.from_settings())["connect"]["retry"]
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


ARM = {"action_features": {"pan.pos": "float"}, "ranges": {"pan.pos": [-1, 1]}}


class AnsweringPeer:
    """A mesh whose peer answers as a test says."""

    def __init__(self, features: object, state: object) -> None:
        self._answers = {"features": features, "state": state}

    def send(self, peer: str, command: dict[str, Any], timeout: float) -> dict[str, Any]:
        return {"status": "ok", "result": self._answers[command["action"]]}


def follower_of(monkeypatch: pytest.MonkeyPatch, features: object, state: object) -> RemoteFollower:
    monkeypatch.setattr("strands_robots.fleet.mesh.leading.await_peer", lambda *_: None)
    mesh: Any = AnsweringPeer(features, state)
    return RemoteFollower(mesh, "arm-1")


@pytest.mark.parametrize(
    ("features", "state", "bounds", "joints"),
    [
        (ARM, {"joints": {"pan.pos": 0, "note": "x"}}, {"pan.pos": (-1.0, 1.0)}, {"pan.pos": 0.0}),
        ({"action_features": ["lift"]}, {}, {"lift": (-math.inf, math.inf)}, {}),
        (
            {"robots": {"arm": {"actuators": {"pan": [0, None], "lift": None}}}},
            {"robots": {"arm": {"pan": 0.5}}},
            {"pan": (0.0, math.inf), "lift": (-math.inf, math.inf)},
            {"pan": 0.5},
        ),
    ],
)
def test_follower_has_the_ranges_and_joints_that_its_peer_reports(
    monkeypatch: pytest.MonkeyPatch, features: object, state: object, bounds: object, joints: object
) -> None:
    follower = follower_of(monkeypatch, features, state)
    assert (follower.bounds, follower.get_joints()) == (bounds, joints)


@pytest.mark.parametrize(
    ("features", "state", "said"),
    [
        ({"action_features": 5}, {}, "action_features"),
        ({"action_features": [5]}, {}, "action key"),
        ({"action_features": "pan"}, {}, "action_features"),
        ({"ranges": [1, 2]}, {}, "ranges"),
        ({"ranges": {"pan": 5}}, {}, "range of 'pan'"),
        ({"ranges": {"pan": [1]}}, {}, "range of 'pan'"),
        ({"ranges": {"pan": ["a", 1]}}, {}, "lower end of 'pan'"),
        ({"ranges": {"pan": [False, True]}}, {}, "lower end of 'pan'"),
        ({"ranges": {"pan": [1, -1]}}, {}, "upper end of 'pan'"),
        ({"ranges": {"pan": [0, 10**400]}}, {}, "upper end of 'pan'"),
        ({"robots": ["arm"]}, {}, "robots"),
        ({"robots": {"arm": []}}, {}, "arm"),
        ({"robots": {"arm": {"actuators": "pan"}}}, {}, "actuators"),
        ({"robots": {"arm": {"actuators": {"pan": None}}}}, {"robots": []}, "robots"),
        ({"robots": {"arm": {"actuators": {"pan": None}}}}, {"robots": {"arm": 3}}, "joints"),
        (ARM, {"joints": [0.0]}, "joints"),
        (ARM, {"joints": {"pan.pos": True}}, "pan.pos"),
        (ARM, {"joints": {"pan.pos": "0"}}, "pan.pos"),
        (ARM, {"joints": {"pan.pos": None}}, "pan.pos"),
    ],
)
def test_peer_whose_answers_have_another_shape_is_refused_by_name(
    monkeypatch: pytest.MonkeyPatch, features: object, state: object, said: str
) -> None:
    with pytest.raises(RobotError, match=f"arm-1 cannot be led.*{said}"):
        follower_of(monkeypatch, features, state)


def test_stream_leads_no_world_of_several_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = {"left": {"actuators": {"pan": None}}, "right": {"actuators": {"pan": None}}}
    with pytest.raises(ValidationError, match="must be one of arm-1/left, arm-1/right, without mesh:"):
        follower_of(monkeypatch, {"robots": arms}, {})


@pytest.mark.parametrize("streams", [5, ["leader"], {"leader": {}}])
def test_streams_of_another_shape_are_no_answer(monkeypatch: pytest.MonkeyPatch, streams: object) -> None:
    follower = follower_of(monkeypatch, ARM, {})
    for bound in ("_ASK_EVERY_S", "_SILENT_S"):
        monkeypatch.setattr(f"strands_robots.fleet.mesh.leading.{bound}", 0.0)
    leader = SimpleNamespace(is_connected=True, get_action=dict)
    led = LedPeer(follower, "leader", LeaderPolicy(leader))
    monkeypatch.setattr(follower, "ask", lambda *_: {"streams": streams})
    assert led.over().startswith("arm-1 is out of reach: arm-1 reports no list of streams")
