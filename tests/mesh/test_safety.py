"""The fleet's emergency stop and its signed resume, on the in-memory transport."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh import safety
from strands_robots.mesh.resume_authority import keygen, load_signing_key, main
from strands_robots.mesh.safety_adapter import SafetyAdapter
from strands_robots.mesh.transport import Sample
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.resume import sign
from strands_robots.utils import ValidationError

PASSPHRASE = "Correct-Horse-7-Battery"


@pytest.fixture
def key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    public = keygen(tmp_path / "operator.pem", PASSPHRASE)
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", public)
    return load_signing_key(tmp_path / "operator.pem", PASSPHRASE)


def bare(reply: dict[str, Any]) -> dict[str, Any]:
    """The result of a reply as peers in the field know it, without the signed part."""
    return {name: value for name, value in reply["result"].items() if name != "statement"}


def test_emergency_stop_halts_and_locks_every_peer_under_one_epoch(peers: Fleet) -> None:
    arms = [Arm(f"arm-{number}") for number in range(3)]
    meshes = [peers.join(arm, arm.tool_name_str) for arm in arms]
    answers = meshes[0].emergency_stop()
    assert answers[0]["responder_id"] == "arm-0"
    assert {answer["responder_id"] for answer in answers} == {"arm-0", "arm-1", "arm-2"}
    epochs = {mesh.lockout_epoch for mesh in meshes}
    assert len(epochs) == 1 and None not in epochs
    assert all(arm.halts for arm in arms)
    recorded = peers.events("emergency_stop")[0]
    assert (recorded["responses_received"], recorded["peers_not_stopped"], recorded["peers_silent"]) == (3, 0, 0)


def test_console_without_robot_adds_no_reply(peers: Fleet) -> None:
    console = peers.join(None, "console")
    assert console.emergency_stop() == []
    peers.join(Arm("arm-1"), "arm-1")
    assert [answer["responder_id"] for answer in console.emergency_stop()] == ["arm-1"]
    assert [each["responses_received"] for each in peers.events("emergency_stop")] == [0, 1]


@pytest.mark.parametrize("assertion", [None, "no object", 5, {"v": 1}])
def test_malformed_resume_is_rejected_and_counted(peers: Fleet, key: Any, assertion: object) -> None:
    arm = peers.join(Arm("arm-1"), "arm-1")
    arm.emergency_stop()
    console = peers.join(None, "console")
    for _ in range(5):
        reply = console.send("arm-1", {"action": "resume", "assertion": assertion, "duration": -1}, timeout=20)
        assert bare(reply) == {"status": "error", "error": "resume rejected"}
    # The sixth is refused whatever it holds: the five were counted.
    good = sign(key, arm.lockout_epoch, ["arm-1"])[0]
    refused = console.send("arm-1", {"action": "resume", "assertion": good}, timeout=20)
    assert refused["result"]["error"] == "resume rejected"
    assert arm.lockout_epoch is not None


def test_hardware_lockout_is_stored_under_its_own_key(peers: Fleet, tmp_path: Path) -> None:
    arm = Arm("arm-1")
    arm.safety_key = "hardware:so101:left"  # type: ignore[attr-defined]  # as real robots have it
    peers.join(arm, "arm-1").emergency_stop()

    def stored() -> list[list[str]]:
        return [list(LockoutStore(path.parent).load_all()) for path in tmp_path.rglob("lockouts")]

    # A stop waits for no disk.
    eventually(lambda: stored() == [["hardware:so101:left"]])


def test_peers_that_did_not_stop_or_answer_are_named(
    peers: Fleet, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 3.0)
    console = peers.join(None, "console")
    peers.join(Arm("stuck", stops=False), "stuck")
    ghost = peers.stranger()
    ghost.put("strands/ghost/presence", {"robot_id": "ghost", "timestamp": peers.clock()})
    console.emergency_stop()
    recorded = peers.events("emergency_stop")[0]
    assert recorded["not_stopped"] == ["stuck"]
    assert recorded["silent"] == ["ghost"]
    critical = [record.getMessage() for record in caplog.records if record.levelname == "CRITICAL"]
    assert any("stuck" in message for message in critical)
    assert any("ghost" in message for message in critical)


def test_estop_is_published_at_once_and_again_with_the_counts(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety, "SPACING_S", 60.0)  # it goes out once more for who has not answered by then
    console = peers.join(None, "console")
    peers.join(Arm(), "arm-1")
    seen: list[dict[str, Any]] = []
    peers.stranger().declare_subscriber("strands/safety/estop", lambda sample: seen.append(json.loads(sample.payload)))
    console.emergency_stop()
    assert [body["responses_received"] for body in seen] == [0, 1]
    assert len({body["estop_id"] for body in seen}) == 1
    assert seen[0]["source_zid"] == peers.transports["console"].session_id
    assert set(seen[1]) == {
        "peer_id", "t", "estop_id", "responses_received", "peers_not_stopped", "peers_silent", "lockout_engaged",
        "source_zid", "pressed_at",
    }  # fmt: skip


@pytest.mark.parametrize("shift", [0.0, -3600.0, 3600.0, 30.0])
def test_estop_counts_whatever_its_time(peers: Fleet, shift: float) -> None:
    arm = Arm()
    mesh = peers.join(arm, "arm-1")
    stranger = peers.stranger()
    body = {"peer_id": "remote", "t": peers.clock() + shift, "estop_id": "a" * 32, "source_zid": stranger.session_id}
    stranger.put("strands/safety/estop", body)
    eventually(lambda: mesh.lockout_epoch == "a" * 32)
    eventually(lambda: arm.halts)
    assert bool(peers.events("estop_clock_skew")) is (shift > 5)
    # A repetition is passed over while the halts of the first are under way.
    eventually(lambda: stranger.put("strands/safety/estop", body) or peers.events("remote_estop_redundant"))
    assert len(arm.halts) == 1


def test_epoch_of_an_estop_without_id_derives_from_issuer_and_time(peers: Fleet) -> None:
    mesh = peers.join(Arm(), "arm-1")
    stranger = peers.stranger()
    stranger.put("strands/safety/estop", {"peer_id": "remote", "t": 1700000000.25, "source_zid": stranger.session_id})
    expected = hashlib.sha256(b"remote\x001700000000.25").hexdigest()[:32]
    eventually(lambda: mesh.lockout_epoch == expected)


@pytest.mark.parametrize(
    "change",
    [
        {"source_zid": "ff"},
        {"source_zid": None},
        {"t": "now"},
        {"t": True},
        {"t": None},
        {"peer_id": ""},
        {"peer_id": 5},
    ],
)
def test_inconsistent_estop_is_rejected(peers: Fleet, change: dict[str, Any]) -> None:
    arm = Arm()
    mesh = peers.join(arm, "arm-1")
    stranger = peers.stranger()
    body = {"peer_id": "remote", "t": peers.clock(), "estop_id": "a" * 32, "source_zid": stranger.session_id, **change}
    stranger.put("strands/safety/estop", body)
    eventually(lambda: peers.events("estop_rejected"))
    assert mesh.lockout_epoch is None


def test_a_locked_peer_refuses_motion_and_answers_reads_and_stops(peers: Fleet) -> None:
    console = peers.join(None, "console")
    world = World("left")
    peers.join(world, "sim-1", "sim")
    console.emergency_stop()
    refused = console.send("sim-1", {"action": "step"}, timeout=20)
    assert refused["error"] == "command rejected", "older callers know it by these words"
    facts = refused["refusal"]
    assert (facts["locked"], facts["refused"], facts["stopped_by"]) == (True, "lockout", "console")
    assert f"epoch {facts['epochs'][0]}" in facts["reason"] and "To resume: " in facts["reason"]
    start = {"action": "start", "policy_provider": "mock"}
    assert console.send("sim-1", start, timeout=20)["error"] == "command rejected"
    for action in ("status", "ping", "stop", "state", "features", "teleop_status", "teleop_stop"):
        assert console.send("sim-1", {"action": action}, timeout=20)["type"] == "response", action


def test_only_the_operators_resume_clears_the_fleet(peers: Fleet, key: Any, tmp_path: Path) -> None:
    console, robot = peers.join(None, "console"), peers.join(Arm(), "arm-1")
    console.emergency_stop()
    keygen(tmp_path / "thief.pem", PASSPHRASE)
    thief = load_signing_key(tmp_path / "thief.pem", PASSPHRASE)
    assert console.resume(thief) == {"status": "error", "error": "resume rejected"}
    assert console.resume("no key") == {"status": "error", "error": "resume rejected"}
    assert robot.lockout_epoch is not None
    assert console.resume(key) == {"status": "ok"}
    assert console.lockout_epoch is None
    eventually(lambda: robot.lockout_epoch is None)
    eventually(lambda: peers.events("remote_resume_applied"))
    assert console.resume(key) == {"status": "error", "error": "resume rejected"}


def test_resume_clears_only_its_targets(peers: Fleet, key: Any) -> None:
    console = peers.join(None, "console")
    first, second = peers.join(Arm(), "arm-1"), peers.join(Arm(), "arm-2")
    console.emergency_stop()
    assert console.resume(key, targets=["arm-1"]) == {"status": "ok"}
    eventually(lambda: first.lockout_epoch is None)
    assert second.lockout_epoch is not None
    assert console.lockout_epoch is None


def test_a_resume_by_command_is_admitted_and_relayed(peers: Fleet, key: Any) -> None:
    first, second = peers.join(Arm(), "arm-1"), peers.join(Arm(), "arm-2")
    console = peers.join(None, "console")
    epoch = None
    console.emergency_stop()
    epoch = first.lockout_epoch
    assert epoch is not None
    [assertion] = sign(key, epoch, ["arm-1", "arm-2"])
    answer = console.send("arm-1", {"action": "resume", "assertion": assertion}, timeout=20)
    assert bare(answer) == {"status": "ok"}
    eventually(lambda: second.lockout_epoch is None)
    assert first.lockout_epoch is None
    again = console.send("arm-1", {"action": "resume", "assertion": assertion}, timeout=20)
    assert bare(again) == {"status": "error", "error": "resume rejected"}


def test_two_stops_need_two_resumes(peers: Fleet, key: Any) -> None:
    one, two = peers.join(Arm(), "arm-1"), peers.join(Arm(), "arm-2")
    one.emergency_stop()
    first = one.lockout_epoch
    two.emergency_stop()
    assert first is not None
    [assertion] = sign(key, first, ["arm-1"])
    console = peers.join(None, "console")
    console.send("arm-1", {"action": "resume", "assertion": assertion}, timeout=20)
    assert one.lockout_epoch not in (None, first)


def test_resume_for_other_peers_does_not_count_as_a_refusal(peers: Fleet, key: Any) -> None:
    robot = peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    console.emergency_stop()
    stranger = peers.stranger()
    for number in range(10):
        assertion = {"epoch": "f" * 32, "targets": ["other"], "nonce": str(number)}
        body = {"peer_id": "x", "t": peers.clock(), "assertion": assertion, "source_zid": stranger.session_id}
        stranger.put("strands/safety/resume", body)
    assert console.resume(key) == {"status": "ok"}
    eventually(lambda: robot.lockout_epoch is None)


def test_retained_estop_locks_a_late_joiner(peers: Fleet) -> None:
    mesh = peers.join(Arm(), "arm-1", sessionless=True)
    body = {"peer_id": "remote", "t": peers.clock() - 86_400, "estop_id": "b" * 32}
    sample = Sample("strands/safety/estop", json.dumps(body).encode(), None, sessionless=True, retained=True)
    peers.bus.deliver(peers.transports["arm-1"], sample)
    eventually(lambda: mesh.lockout_epoch == "b" * 32)


def test_retained_estop_followed_by_a_signed_resume_does_not_lock(peers: Fleet, key: Any) -> None:
    mesh = peers.join(Arm(), "arm-1", sessionless=True)
    [assertion] = sign(key, "b" * 32, ["arm-1"], clock=lambda: peers.clock() - 3600)
    relay = {"peer_id": "remote", "t": peers.clock() - 3600, "assertion": assertion}
    estop = {"peer_id": "remote", "t": peers.clock() - 7200, "estop_id": "b" * 32}
    for key_, body in (("resume", relay), ("estop", estop)):
        sample = Sample(f"strands/safety/{key_}", json.dumps(body).encode(), None, sessionless=True, retained=True)
        peers.bus.deliver(peers.transports["arm-1"], sample)
    eventually(lambda: peers.events("remote_estop_redundant"))
    assert mesh.lockout_epoch is None


def test_keygen_asks_twice_and_prints_the_public_half(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "operator.pem"
    assert main(["keygen", str(path)], ask=lambda prompt: prompt) == 1
    assert main(["keygen", str(path)], ask=lambda prompt: "short") == 1
    assert main(["sign"], ask=lambda prompt: PASSPHRASE) == 2
    assert main(["keygen", str(path)], ask=lambda prompt: PASSPHRASE) == 0
    assert len(capsys.readouterr().out.strip()) >= 43
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(ValueError, match="passphrase"):
        load_signing_key(path, "Wrong-Horse-7-Battery")


def test_another_robot_under_a_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    plane = SafetyPlane(LockoutStore(tmp_path))
    adapter = SafetyAdapter("arm-1", Arm("one"), None, plane)
    with pytest.raises(ValidationError, match="arm-1"):
        SafetyAdapter("arm-1", Arm("another"), None, plane)
    adapter.close()
    SafetyAdapter("arm-1", Arm("another"), None, plane).close()


def test_the_same_robot_on_a_second_network_shares_its_lockout(tmp_path: Path) -> None:
    plane = SafetyPlane(LockoutStore(tmp_path))
    arm = Arm("one")
    first = plane.register("arm-1", arm)
    adapter = SafetyAdapter("arm-1", arm, None, plane)
    order = StopOrder(new_epoch(), "console", "test", "mesh")
    verdict = adapter.begin(order)
    assert verdict is not None
    assert verdict() is not None
    assert adapter.epochs() == first.epochs == (order.epoch,)
    assert len(arm.halts) == 1
    adapter.close()
    first.close()
