"""Answers of mesh peers to stops, and their lockout state, are signed by the robot's key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.cli.stop import exit_code, style_of
from strands_robots.fleet.mesh.stops import MeshController, ask_peers
from strands_robots.mesh import topics
from strands_robots.mesh.safety_adapter import SafetyAdapter
from strands_robots.safety.identity import ROBOTS, EnrolledKeys, KeyFile, robot_identity
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.statements import (
    ANNOUNCED_S,
    LockoutAnnouncer,
    lockout_distrust,
    resume_distrust,
    stop_distrust,
    with_stop_statement,
)

STOP = {"action": "stop"}


def enroll(name: str, *, shown_by: str = "") -> None:
    """Enroll the robot with its key, or with that of another one."""
    identity = robot_identity(shown_by or name)
    assert identity is not None
    EnrolledKeys().enroll({name: identity.public})


def keyless(name: str) -> None:
    """Let the robot have a key file that it must not use."""
    file = KeyFile(ROBOTS, name)
    file.load_or_make()
    file.path.chmod(0o644)


def test_answer_to_a_stop_is_signed_for_its_turn(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    enroll("arm-1")
    keys = EnrolledKeys().load()
    first, second = (console.send("arm-1", STOP, 20) for _ in range(2))
    assert first["result"]["ok"] is True
    assert stop_distrust(first, keys) == ""
    recorded = {**second, "result": first["result"]}
    assert "ALARM" in stop_distrust(recorded, keys)
    changed = {**first, "result": {**first["result"], "not_stopped": ["arm-1"]}}
    assert "ALARM" in stop_distrust(changed, keys)
    unsigned = {**first, "result": {"ok": True}}
    assert "only claimed" in stop_distrust(unsigned, keys)
    assert "only claimed" in stop_distrust(first, None)
    stranger = with_stop_statement(robot_identity("stranger"), "arm-1", first["turn_id"], {"ok": True})
    assert "ALARM" in stop_distrust({**first, "result": stranger}, keys)
    assert stop_distrust(unsigned, {}) == ""


@pytest.mark.parametrize(
    ("case", "code", "style"), [("signed", 0, "green"), ("claimed", 3, "yellow"), ("wrong key", 1, "bold red")]
)
def test_a_stop_of_the_mesh_is_green_only_by_the_enrolled_key(peers: Fleet, case: str, code: int, style: str) -> None:
    enroll("arm-1", shown_by="arm-2" if case == "wrong key" else "")
    if case == "claimed":
        keyless("arm-1")
    peers.join(Arm(), "arm-1")
    controller = MeshController(peers.join(None, "safety-1"))
    report = controller.stop(["arm-1"])
    assert (exit_code(report), style_of(report)) == (code, style)
    assert ("arm-1" in report.unanswered) is (code != 0)


def test_lockout_state_of_an_enrolled_peer_needs_its_signature(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    console.emergency_stop()

    def asked() -> Any:
        [report] = ask_peers(console, ["arm-1"], 20)
        return report

    assert (asked().problem, len(asked().lockouts)) == ("", 1)
    enroll("arm-1")
    assert (asked().problem, len(asked().lockouts)) == ("", 1)
    EnrolledKeys().forget("arm-1")
    enroll("arm-1", shown_by="arm-2")
    assert "ALARM" in asked().problem
    assert asked().lockouts == ()


def test_recorded_status_is_no_answer_to_a_later_question(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    enroll("arm-1")
    keys = EnrolledKeys().load()
    nonces = [new_epoch(), new_epoch()]
    answers = [console.send("arm-1", {"action": "status", "nonce": each}, 20)["result"] for each in nonces]
    proven = [lockout_distrust("arm-1", answers[n], [], keys, nonces[n]) for n in range(2)]
    assert proven == ["", ""]
    assert "ALARM" in lockout_distrust("arm-1", answers[0], [], keys, nonces[1])
    plain = console.send("arm-1", {"action": "status"}, 20)["result"]
    assert "ALARM" in lockout_distrust("arm-1", plain, [], keys, nonces[1])


def test_announced_lockout_state_is_signed_in_presence_and_in_state(peers: Fleet) -> None:
    arm = peers.join(Arm(), "arm-1")
    states = received(peers, topics.state("arm-1"))
    console = peers.join(None, "console")
    enroll("arm-1")
    keys = EnrolledKeys().load()
    arm.emergency_stop()
    epochs = [arm.lockout_epoch]

    def distrusts(facts: Any) -> str:
        return lockout_distrust("arm-1", facts, facts.get("epochs"), keys)

    peers.meet()
    assert console.peers_by_id["arm-1"]["epochs"] == epochs
    row = console.peers_by_id["arm-1"]
    assert distrusts(row) == ""
    eventually(lambda: any(each.get("epochs") == epochs for each in states))
    assert distrusts(states[-1]) == ""
    assert "ALARM" in distrusts({**row, "locked": False, "epochs": []})
    assert "only claimed" in distrusts({"locked": False, "epochs": []})


def test_announced_state_is_signed_anew_when_it_changes_or_ages() -> None:
    now = [0.0]
    announcer = LockoutAnnouncer(robot_identity("arm-1"), lambda: now[0])
    free, locked = {"locked": False, "epochs": []}, {"locked": True, "epochs": [new_epoch()]}
    first = announcer.of("arm-1", free)
    assert announcer.of("arm-1", free) is first
    assert announcer.of("arm-1", locked)["statement"]["locked"] is True
    assert announcer.of("arm-1", locked)["epochs"] == locked["epochs"]
    at = announcer.of("arm-1", locked)["statement"]["t"]
    now[0] = ANNOUNCED_S
    assert announcer.of("arm-1", locked)["statement"]["t"] > at
    assert LockoutAnnouncer(None).of("arm-1", free) == free


def test_answer_to_a_resume_is_signed_for_its_assertion(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    enroll("arm-1")
    keys = EnrolledKeys().load()
    wrong = [{"v": 1, "epoch": new_epoch(), "targets": ["arm-1"], "nonce": new_epoch()} for _ in range(2)]
    answers = [console.send("arm-1", {"action": "resume", "assertion": each}, timeout=20)["result"] for each in wrong]
    assert [each["status"] for each in answers] == ["error", "error"]
    assert [resume_distrust("arm-1", *pair, keys) for pair in zip(wrong, answers, strict=True)] == ["", ""]
    assert "ALARM" in resume_distrust("arm-1", wrong[0], answers[1], keys)
    assert "ALARM" in resume_distrust("arm-1", wrong[0], {**answers[0], "status": "ok"}, keys)
    assert "only claimed" in resume_distrust("arm-1", wrong[0], {"status": "ok"}, keys)
    assert "only claimed" in resume_distrust("arm-1", wrong[0], answers[0], None)


def test_robots_of_an_enrolled_world_answer_with_its_key(peers: Fleet) -> None:
    peers.join(World("left", "right"), "sim-1", "sim")
    console = peers.join(None, "console")
    child = "sim-1__left"
    eventually(lambda: child in console.peers_by_id)
    enroll("sim-1")
    keys = EnrolledKeys().load()
    assert stop_distrust(console.send(child, STOP, 20), keys) == ""
    row, status = console.peers_by_id[child], console.send(child, {"action": "status"}, 20)["result"]
    assertion = {"nonce": new_epoch()}
    resumed = console.send(child, {"action": "resume", "assertion": assertion}, 20)["result"]
    assert [lockout_distrust(child, each, [], keys) for each in (row, status)] == ["", ""]
    assert resume_distrust(child, assertion, resumed, keys) == ""
    parent = console.send("sim-1", {"action": "status"}, 20)["result"]
    assert "ALARM" in lockout_distrust(child, parent, [], keys), "the answer of one is none of another"
    assert "only claimed" in stop_distrust({"responder_id": child, "turn_id": "t", "result": {"ok": True}}, keys)


def test_answer_of_a_robot_to_a_question_signs_its_cell(tmp_path: Path) -> None:
    adapter = SafetyAdapter("arm-1", Arm("one"), None, SafetyPlane(LockoutStore(tmp_path)), cell="cell-1")
    enroll("arm-1")
    answer = adapter.report(nonce="a" * 32)
    assert answer["cell"] == answer["statement"]["cell"] == "cell-1"
    assert not lockout_distrust("arm-1", answer, [], EnrolledKeys().load(), "a" * 32)
    moved = {**answer, "statement": {**answer["statement"], "cell": "cell-2"}}
    assert lockout_distrust("arm-1", moved, [], EnrolledKeys().load(), "a" * 32).startswith("ALARM")
    adapter.close()
