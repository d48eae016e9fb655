"""An emergency stop is repeated to the peers that missed it."""

from __future__ import annotations

import time

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, ScriptedPeer

from strands_robots.mesh import estop_retry, safety
from strands_robots.mesh.core import Mesh


@pytest.fixture(autouse=True)
def brief(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Collect answers for a moment only."""
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)


def cut_off(peers: Fleet) -> tuple[Mesh, Mesh, Arm]:
    """A console that issued a stop while one arm was cut off from all others."""
    arm = Arm()
    console, remote = peers.join(None, "console"), peers.join(arm, "arm-1")
    peers.bus.partition(peers.transports["arm-1"])
    peers.clock.pass_(1)
    console.emergency_stop()
    peers.clock.pass_(1)
    assert remote.lockout_epoch is None
    return console, remote, arm


def test_a_robot_that_was_cut_off_is_stopped_and_locked_when_it_is_back(peers: Fleet) -> None:
    console, remote, arm = cut_off(peers)
    assert peers.events("emergency_stop")[0]["silent"] == ["arm-1"]
    peers.bus.partition(peers.transports["arm-1"], cut=False)
    peers.meet()
    eventually(lambda: remote.lockout_epoch == console.lockout_epoch)
    eventually(lambda: arm.halts)


def test_robot_dropped_from_the_registry_is_stopped_when_it_is_back(peers: Fleet) -> None:
    arm = Arm()
    console, remote = peers.join(None, "console"), peers.join(arm, "arm-1")
    peers.bus.partition(peers.transports["arm-1"])
    peers.clock.pass_(60)
    eventually(lambda: console.peers == [], what="the silent arm is dropped")
    console.emergency_stop()
    peers.bus.partition(peers.transports["arm-1"], cut=False)
    peers.meet()
    eventually(lambda: remote.lockout_epoch == console.lockout_epoch)


def test_cleared_stop_is_not_repeated(peers: Fleet) -> None:
    _, remote, arm = cut_off(peers)
    peers.planes["console"].clear_local("operator")
    peers.bus.partition(peers.transports["arm-1"], cut=False)
    peers.meet()
    # Longer than two rounds of repeats.
    time.sleep(1.3)
    assert remote.lockout_epoch is None
    assert arm.halts == []


def test_newcomer_is_not_stopped(peers: Fleet) -> None:
    cut_off(peers)
    late = Arm()
    mesh = peers.join(late, "arm-2")
    time.sleep(1.3)
    assert mesh.lockout_epoch is None
    assert late.halts == []


def test_peer_in_reach_that_never_answers_is_given_up(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(estop_retry, "RETRY_EVERY_S", 0.05)
    monkeypatch.setattr(estop_retry, "RETRY_ANSWER_S", 0.02)
    console, ghost = peers.join(None, "console"), peers.stranger()
    heartbeat = {"robot_id": "ghost", "timestamp": peers.clock()}
    ghost.put("strands/ghost/presence", heartbeat)
    requests: list[str] = []
    ghost.declare_subscriber("strands/ghost/cmd", lambda sample: requests.append(sample.key))
    console.emergency_stop()
    # Requests so remote belong to the stop itself; it is repeated after the next heartbeat.
    requests.clear()
    peers.clock.pass_(1)
    ghost.put("strands/ghost/presence", {**heartbeat, "timestamp": peers.clock()})
    eventually(lambda: "is in reach and does not answer" in caplog.text)
    assert len(requests) == estop_retry.UNANSWERED_MAX


def test_returning_peer_that_does_not_stop_is_logged_once_and_asked_until_it_stops(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(estop_retry, "RETRY_EVERY_S", 0.05)
    _, _, arm = cut_off(peers)
    arm.stops = False
    peers.bus.partition(peers.transports["arm-1"], cut=False)
    peers.meet()
    eventually(lambda: len(arm.halts) > estop_retry.UNANSWERED_MAX, what="the stop is repeated")
    named = [line for line in caplog.records if line.levelname == "CRITICAL" and "did NOT stop" in line.getMessage()]
    assert len(named) == 1
    assert "the brake is stuck" in named[0].getMessage()
    assert "has answered emergency stop" not in caplog.text
    arm.stops = True
    eventually(lambda: "has answered emergency stop" in caplog.text)


def test_error_reply_does_not_count_as_stopped(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(estop_retry, "RETRY_EVERY_S", 0.05)
    monkeypatch.setattr(estop_retry, "RETRY_ANSWER_S", 20.0)
    console = peers.join(None, "console")
    faulty = ScriptedPeer(peers, "faulty", 0.0, first={"type": "error", "error": "dispatch error"})
    peers.bus.partition(faulty.wire)
    peers.clock.pass_(1)
    console.emergency_stop()
    peers.clock.pass_(1)
    assert faulty.turns == []
    peers.bus.partition(faulty.wire, cut=False)
    faulty.wire.put("strands/faulty/presence", {"robot_id": "faulty", "timestamp": peers.clock()})
    eventually(lambda: "faulty has answered emergency stop" in caplog.text)
    faulty.join()
    assert len(faulty.turns) == 2
    assert any(line.levelname == "CRITICAL" and "dispatch error" in line.getMessage() for line in caplog.records)
