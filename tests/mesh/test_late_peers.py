"""A lockout outlives its issuer: late peers get the stop and the resume, and any console may resume."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.mesh import core, estop_retry, safety
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.resume_authority import keygen, load_signing_key
from strands_robots.safety.identity import EnrolledKeys, robot_identity

PASSPHRASE = "Correct-Horse-7-Battery"


@pytest.fixture(autouse=True)
def brief(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Collect answers for a moment only, and look for late peers at once."""
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)
    monkeypatch.setattr(estop_retry, "AGAIN_S", 0.1)
    monkeypatch.setattr(estop_retry, "SPREAD_S", 0.0)
    monkeypatch.setattr(core, "LATE_HZ", 20.0)


@pytest.fixture
def key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(tmp_path / "operator.pem", PASSPHRASE))
    return load_signing_key(tmp_path / "operator.pem", PASSPHRASE)


def stopped_fleet(peers: Fleet) -> tuple[Mesh, Mesh]:
    """Two arms that a console stopped, one of them out of its reach; the console is gone."""
    first, second = peers.join(Arm("arm-1"), "arm-1"), peers.join(Arm("arm-2"), "arm-2")
    console = peers.join(None, "console")
    peers.bus.partition(peers.transports["arm-2"])
    peers.clock.pass_(1)
    console.emergency_stop()
    console.close()
    assert (first.lockout_epoch is None, second.lockout_epoch) == (False, None)
    return first, second


def is_back(peers: Fleet, name: str) -> None:
    peers.clock.pass_(2)
    peers.bus.partition(peers.transports[name], cut=False)
    peers.meet()


def test_robot_that_missed_the_stop_gets_it_from_another_when_the_console_is_gone(peers: Fleet) -> None:
    first, second = stopped_fleet(peers)
    is_back(peers, "arm-2")
    eventually(lambda: second.lockout_epoch == first.lockout_epoch)


def test_unsigned_word_that_an_enrolled_robot_is_locked_keeps_no_stop_from_it(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    identity = robot_identity("arm-2")
    assert identity is not None
    EnrolledKeys().enroll({"arm-2": identity.public})
    first, second = stopped_fleet(peers)
    claimed = {"locked": True, "epochs": [first.lockout_epoch]}
    monkeypatch.setattr(second._adapter, "announced", lambda peer_id: claimed)
    is_back(peers, "arm-2")
    eventually(lambda: second.lockout_epoch == first.lockout_epoch)


def test_newcomer_gets_no_stop_from_robots(peers: Fleet) -> None:
    first, _ = stopped_fleet(peers)
    late = peers.join(Arm("arm-3"), "arm-3")
    for _ in range(3):
        peers.clock.pass_(1)
        peers.meet()
        first._safety.late.look()
    assert late.lockout_epoch is None


def test_stop_that_was_resumed_is_not_repeated(peers: Fleet) -> None:
    first, second = stopped_fleet(peers)
    peers.planes["arm-1"].clear_local("operator")
    envelopes = received(peers, "strands/safety/estop")
    is_back(peers, "arm-2")
    first._safety.late.look()
    assert (envelopes, second.lockout_epoch) == ([], None)


def test_peer_that_goes_on_reporting_no_lockout_is_given_up(peers: Fleet) -> None:
    ghost = peers.stranger()
    heartbeat = {"robot_id": "ghost", "locked": False, "epochs": []}
    first, console = peers.join(Arm("arm-1"), "arm-1"), peers.join(None, "console")
    ghost.put("strands/ghost/presence", {**heartbeat, "timestamp": peers.clock()})
    console.emergency_stop()
    console.close()
    envelopes = received(peers, "strands/safety/estop")
    peers.clock.pass_(2)
    ghost.put("strands/ghost/presence", {**heartbeat, "timestamp": peers.clock()})
    eventually(lambda: len(envelopes) == estop_retry.TRIES_MAX)
    first._safety.late.look()
    assert len(envelopes) == estop_retry.TRIES_MAX


def test_another_console_resumes_what_a_console_that_is_gone_has_stopped(peers: Fleet, key: Any) -> None:
    first, _ = stopped_fleet(peers)
    other = peers.join(None, "console-2")
    assert other.lockout_epoch is None
    assert other.resume(key) == {"status": "ok"}
    eventually(lambda: first.lockout_epoch is None)
    assert other.resume(key) == {"status": "error", "error": "resume rejected"}


def test_key_that_robots_do_not_know_is_refused_at_once(peers: Fleet, key: Any, tmp_path: Path) -> None:
    stopped_fleet(peers)
    keygen(tmp_path / "thief.pem", PASSPHRASE)
    other = peers.join(None, "console-2")
    relays = received(peers, "strands/safety/resume")
    refused = other.resume(load_signing_key(tmp_path / "thief.pem", PASSPHRASE))
    assert (refused["status"], relays) == ("error", [])


@pytest.mark.parametrize("console_stays", [True, False])
def test_robot_that_missed_the_resume_is_freed_when_it_is_back(peers: Fleet, key: Any, console_stays: bool) -> None:
    first, second = peers.join(Arm("arm-1"), "arm-1"), peers.join(Arm("arm-2"), "arm-2")
    console = peers.join(None, "console")
    console.emergency_stop()
    eventually(lambda: second.lockout_epoch is not None)
    peers.bus.partition(peers.transports["arm-2"])
    assert console.resume(key) == {"status": "ok"}
    eventually(lambda: first.lockout_epoch is None)
    if console_stays:
        # Longer than a recorded resume is good for: the console signs a new one.
        peers.clock.pass_(90)
        peers.bus.partition(peers.transports["arm-1"])
    else:
        console.close()
    assert second.lockout_epoch is not None
    is_back(peers, "arm-2")
    eventually(lambda: second.lockout_epoch is None)


@pytest.mark.parametrize("robot", ["arm", "world"])
def test_lockout_is_in_status_state_and_presence(peers: Fleet, robot: str) -> None:
    body = Arm("r-1") if robot == "arm" else World("left", "right")
    mesh, console = peers.join(body, "r-1", "robot" if robot == "arm" else "sim"), peers.join(None, "console")
    states = received(peers, "strands/r-1/state")
    row = eventually(lambda: console.get_peer("r-1"))
    assert (row["locked"], row["epochs"]) == (False, [])
    console.emergency_stop()
    epoch = mesh.lockout_epoch
    eventually(lambda: states and (states[-1]["locked"], states[-1]["epochs"]) == (True, [epoch]))
    eventually(lambda: (console.get_peer("r-1") or {})["epochs"] == [epoch])
    status = console.send("r-1", {"action": "status"}, timeout=20)["result"]
    assert (status["locked"], status["epochs"]) == (True, [epoch])
    assert (status["lockout"][0]["epoch"], status["lockout"][0]["source"]) == (epoch, "console")
    if robot == "world":
        child = eventually(lambda: console.get_peer("r-1__left"))
        assert child["epochs"] == [epoch]
        assert console.send("r-1__left", {"action": "status"}, timeout=20)["result"]["epochs"] == [epoch]


def test_console_without_a_robot_reports_no_lockout(peers: Fleet) -> None:
    console, other = peers.join(None, "console"), peers.join(None, "console-2")
    console.emergency_stop()
    peers.meet()
    assert "locked" not in (other.get_peer("console") or {})


def test_resume_is_published_once_more_for_an_older_peer_in_reach_unless_another_stop_follows(
    peers: Fleet, key: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may have dropped the resume, and cannot say; five of another stop's epoch would close it to every resume."""
    monkeypatch.setattr(estop_retry, "SETTLE_S", 0.1)
    older, robot = peers.stranger(), peers.join(Arm("arm-1"), "arm-1")

    def beat() -> None:
        peers.clock.pass_(2)
        older.put("strands/old-1/presence", {"robot_id": "old-1", "timestamp": peers.clock()})

    beat()
    eventually(lambda: robot.get_peer("old-1"), what="the older peer is known")
    resumes = received(peers, "strands/safety/resume")

    def resumed(again: bool) -> list[bool]:
        robot.emergency_stop()
        epoch = robot.lockout_epoch
        resumes.clear()
        assert robot.resume(key) == {"status": "ok"}
        if again:
            robot.emergency_stop()
        beat()
        time.sleep(0.5)  # some looks
        beat()
        time.sleep(0.5)
        assert epoch is not None
        return [each["assertion"]["epoch"] == epoch for each in resumes]

    assert resumed(again=False) == [True, True]
    assert resumed(again=True) == [True]
