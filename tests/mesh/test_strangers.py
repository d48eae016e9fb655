"""Strangers on a mesh without certificates: a copied source, a flood of names, captured and forged signatures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received, signed

from strands_robots.mesh import commands, safety, session
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.input import InputReceiver
from strands_robots.mesh.transport import Sample
from strands_robots.mesh.wire_identity import INPUT, MOTION, ConsoleSigner

START = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 0.5}
TRIES = 1000


@pytest.fixture
def approved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")


def as_console(peers: Fleet, key: str, body: dict[str, Any]) -> None:
    """Publish with the source of the console copied."""
    peers.bus.deliver(peers.stranger(), Sample(key, json.dumps(body).encode(), peers.transports["console"].session_id))


def fleet_of(peers: Fleet) -> tuple[Arm, Mesh]:
    arm = Arm()
    peers.join(arm, "arm-1")
    return arm, peers.join(None, "console")


def command(peers: Fleet, number: int, **more: Any) -> dict[str, Any]:
    turn = f"{number:032x}"
    head = {"sender_id": "console", "turn_id": turn, "timestamp": peers.clock(), "target_id": "arm-1"}
    return {**head, "command": START, **more}


def test_console_of_the_same_user_moves_hardware_without_a_further_step(peers: Fleet, approved: None) -> None:
    arm, console = fleet_of(peers)
    assert console.send("arm-1", START, timeout=20)["result"]["status"] == "success"
    assert arm.started == ["wave"]


def test_copied_source_moves_nothing(peers: Fleet, approved: None) -> None:
    arm, console = fleet_of(peers)
    for number in range(TRIES):
        as_console(peers, "strands/arm-1/cmd", command(peers, number))
    assert eventually(lambda: console.ping("arm-1", 2)["status"] == "ok")
    eventually(lambda: peers.events("wire_motion_refused"))
    assert arm.started == []


@pytest.mark.parametrize("forgery", ["own key", "changed command", "another target", "another purpose", "no object"])
def test_forged_signature_moves_nothing(
    peers: Fleet, approved: None, forgery: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, _ = fleet_of(peers)
    bodies = []
    with monkeypatch.context() as elsewhere:
        if forgery == "own key":
            elsewhere.setenv("STRANDS_STATE_DIR", str(tmp_path / "mallory"))
        signer, purpose = ConsoleSigner(peers.clock), INPUT if forgery == "another purpose" else MOTION
        for number in range(20):
            target = {"target_id": "arm-2"} if forgery == "another target" else {}
            bodies.append(signer.sign(command(peers, number, **target), purpose))
    for body in bodies:
        if forgery == "changed command":
            body["command"] = {**START, "instruction": "hit"}
        if forgery == "no object":
            body["console"] = [1]
        as_console(peers, "strands/arm-1/cmd", body)
    eventually(lambda: peers.events("wire_motion_refused"))
    assert arm.started == []


def test_captured_command_moves_no_other_robot_and_counts_once(peers: Fleet, approved: None) -> None:
    arm, console = fleet_of(peers)
    other = Arm("arm-2")
    peers.join(other, "arm-2")
    captured = received(peers, "strands/arm-1/cmd")
    console.send("arm-1", START, timeout=20)
    for _ in range(20):
        for name in ("arm-1", "arm-2"):
            as_console(peers, f"strands/{name}/cmd", captured[0])
    eventually(lambda: peers.events("wire_motion_refused"))
    assert (arm.started, other.started) == (["wave"], [])


def captured_of(peers: Fleet, console: Mesh) -> dict[str, Any]:
    """The start of arm-1 that its console sent and that was carried out."""
    captured = received(peers, "strands/arm-1/cmd")
    assert console.send("arm-1", START, timeout=20)["result"]["status"] == "success"
    return dict(captured[0])


def test_captured_command_does_not_count_again_after_a_restart(peers: Fleet, approved: None) -> None:
    arm, console = fleet_of(peers)
    captured = captured_of(peers, console)
    peers.clock.pass_(1.0)
    peers.meshes[0].close()
    assert len(arm.started) == 1
    peers.join(arm, "arm-1")
    as_console(peers, "strands/arm-1/cmd", captured)
    why = eventually(lambda: peers.events("wire_motion_refused"))[0]["reason"]
    assert "before this peer started" in why
    assert console.send("arm-1", START, timeout=20)["result"]["status"] == "success"
    assert len(arm.started) == 2


def test_captured_frame_does_not_count_again_after_a_restart(peers: Fleet) -> None:
    arm, _ = fleet_of(peers)
    frame = {"peer_id": "console", "device": "leader", "method": "arm", "t": peers.clock(), "seq": 1, "events": None}
    captured = signed(peers, {**frame, "action": {"shoulder.pos": 1.0}})
    peers.clock.pass_(1.0)
    peers.meshes[0].close()
    mesh = peers.join(arm, "arm-1")
    assert mesh.inputs.refusal(captured) == "it was sent before this peer started, by its sender's clock"
    later = {**frame, "t": peers.clock(), "action": {"shoulder.pos": 1.0}}
    assert mesh.inputs.refusal(signed(peers, later)) is None


def test_flood_of_unsigned_commands_lets_no_captured_one_count_again(
    peers: Fleet, approved: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "REPLAYS_MAX", 8)
    arm, console = fleet_of(peers)
    captured = captured_of(peers, console)
    for number in range(20):
        as_console(peers, "strands/arm-1/cmd", command(peers, number))
        # One after another: what is more than the workers take at once is answered as busy.
        eventually(lambda number=number: len(peers.events("wire_motion_refused")) > min(number, 4))  # type: ignore[misc]
    as_console(peers, "strands/arm-1/cmd", captured)
    assert console.send("arm-1", {"action": "status"}, timeout=20)["type"] == "response"
    assert arm.started == ["wave"]


def test_console_of_another_machine_moves_hardware_once_its_key_is_set(
    peers: Fleet, approved: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, _ = fleet_of(peers)
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("STRANDS_STATE_DIR", str(tmp_path / "laptop"))
        body = ConsoleSigner(peers.clock).sign(command(peers, 1), MOTION)
    monkeypatch.setenv("STRANDS_MESH_CONSOLE_PUBLIC_KEYS", body["console"]["key"])
    as_console(peers, "strands/arm-1/cmd", body)
    eventually(lambda: arm.started == ["wave"])


def test_copied_source_injects_no_frame_and_captured_frames_count_once(peers: Fleet) -> None:
    arm, console = fleet_of(peers)
    follower = InputReceiver(peers.meshes[0], arm, "console")
    follower.start()
    frame = {"peer_id": "console", "device": "leader", "method": "arm", "t": peers.clock(), "events": None}
    for number in range(TRIES):
        as_console(peers, "strands/console/input/leader", {**frame, "seq": number, "action": {"shoulder.pos": 9.0}})
    true = signed(peers, {**frame, "t": peers.clock() + 0.01, "seq": 1, "action": {"shoulder.pos": 1.0}})
    console.publish("strands/console/input/leader", true)
    eventually(lambda: arm.actions == [{"shoulder.pos": 1.0}])
    follower.stop()
    follower.start()
    as_console(peers, "strands/console/input/leader", true)
    eventually(lambda: follower.stop()["rejected_source"])
    assert len(arm.actions) == 1


def test_flood_of_names_evicts_no_living_peer_and_a_frozen_robot_is_named(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)
    _, console = fleet_of(peers)
    peers.bus.partition(peers.transports["arm-1"])
    for flood in range(20):
        stranger = peers.stranger()
        for number in range(100):
            name = f"ghost-{flood}-{number}"
            stranger.put(f"strands/{name}/presence", {"robot_id": name, "timestamp": peers.clock()})
    assert len(console.peers) <= 1024
    assert console.peer_wire_zid("arm-1") == peers.transports["arm-1"].session_id
    console.emergency_stop()
    assert "arm-1" in peers.events("emergency_stop")[0]["silent"]
    assert peers.events("presence_left_out")


def test_silent_row_makes_place_for_a_newcomer() -> None:
    now = [0.0]
    table = session.PeerRegistry(clock=lambda: now[0], most=lambda: 2)
    assert table.update("a", "robot", "", {}) and table.update("b", "robot", "", {})
    assert not table.update("c", "robot", "", {})
    now[0] = 20.0
    table.update("b", "robot", "", {})
    assert table.update("c", "robot", "", {})
    assert {row["peer_id"] for row in table.all()} == {"b", "c"}
    assert "a" in table.seen_within(60)


def test_peer_whose_clock_is_six_seconds_ahead_is_named(peers: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    console = peers.join(None, "console")
    for _ in range(3):
        body = {"robot_id": "arm-6", "timestamp": peers.clock() + 6}
        peers.stranger().put("strands/arm-6/presence", body)
    assert console.get_peer("arm-6") is None
    named = [each.getMessage() for each in caplog.records if "arm-6 is left out" in each.getMessage()]
    assert named == [
        "arm-6 is left out: its clock is 6 s ahead of ours, and a heartbeat may be 5 s ahead and 60 s behind."
    ]
