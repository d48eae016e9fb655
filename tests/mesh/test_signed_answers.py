"""Answers of mesh peers to stops, and their lockout state, are signed by the robot's key."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from tests.mesh.peers import Fleet

from strands_robots.cli.mesh_controller import MeshController
from strands_robots.cli.resume_mesh import ask_peers
from strands_robots.cli.stop import exit_code, style_of
from strands_robots.safety.identity import ROBOTS, EnrolledKeys, KeyFile, robot_identity
from strands_robots.safety.peer_answers import stop_distrust, with_stop_statement

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
