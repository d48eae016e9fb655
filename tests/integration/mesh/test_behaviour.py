"""The behaviour of a mesh, the same on every transport.

Three peers: an operator's console, a simulated world and a real arm. Over Zenoh and MQTT each is a process.
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.integration.mesh.networks import Network, network

from strands_robots.mesh.input_receiver import LOST_S
from strands_robots.mesh.resume_authority import keygen
from strands_robots.mesh.transport import Transport

PASSPHRASE = "Correct-Horse-7-Battery"
APPROVED = "execute@arm-1,start@arm-1,teleop_receive@arm-1"
WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}


NETWORKS = [
    "memory",
    "zenoh",
    "zenoh-tls",
    *(pytest.param(each, marks=pytest.mark.system) for each in ("mqtt", "bridge")),
]


@pytest.fixture(scope="module", params=NETWORKS)
def net(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    folder = tmp_path_factory.mktemp("network")
    public = keygen(folder / "operator.pem", PASSPHRASE)
    settings = {"STRANDS_MESH_RESUME_PUBLIC_KEY": public, "STRANDS_ROBOT_COMMAND_ALLOW": APPROVED}
    with network(request.param, folder, settings) as made:
        names = {"console": "none", "sim-1": "world", "arm-1": "arm"}
        for peer_id, robot in names.items():
            made.join(peer_id, robot)
        for peer_id, peer in made.peers.items():
            peer.sees(*(other for other in names if other != peer_id))
        yield made


@pytest.fixture(autouse=True)
def free(net: Network) -> Iterator[None]:
    """Every test leaves its peers standing still and unlocked."""
    yield
    for peer in net.peers.values():
        peer.ask("clear")
    for robot in ("sim-1", "arm-1"):
        net.peers["console"].ask("send", robot, {"action": "stop"}, 20)


def request(sender: str, command: object, **fields: Any) -> dict[str, Any]:
    """A hand-made command."""
    return {"sender_id": sender, "turn_id": uuid.uuid4().hex, "command": command, "timestamp": time.time(), **fields}


def replies_to(transport: Transport, sender: str) -> list[dict[str, Any]]:
    """Everything that is answered to ``sender`` from now on, whoever that is."""
    messages: list[dict[str, Any]] = []
    key = f"strands/{sender}/response/**"
    transport.declare_subscriber(key, lambda sample: messages.append(json.loads(sample.payload)))
    return messages


def until_answered(
    transport: Transport, key: str, body: dict[str, Any], messages: list[dict[str, Any]]
) -> dict[str, Any]:
    """Publish until an answer comes: a new subscription takes a moment."""

    def ask() -> dict[str, Any] | None:
        if not messages:
            # As another turn each time: the same one would be refused as a replay of what was not answered to us.
            transport.put(key, {**body, "turn_id": uuid.uuid4().hex})
            time.sleep(0.1)
        return messages[0] if messages else None

    return eventually(ask, what="an answer") or {}


# Who is there.


def test_peer_publishes_its_description(net: Network) -> None:
    rows = {row["peer_id"]: row for row in net.peers["console"].ask("peers")}
    assert (rows["sim-1"]["type"], rows["sim-1"]["world"], rows["sim-1"]["sim_robots"]) == ("sim", True, ["left"])
    assert (rows["arm-1"]["type"], rows["arm-1"]["tool_name"]) == ("robot", "arm-1")
    for row in rows.values():
        assert row["reachable"] is True
        assert 0 <= row["age"] < 10
        assert row["hostname"]
    assert "console" not in rows


def test_a_peer_is_bound_to_the_session_it_came_from(net: Network) -> None:
    net.needs("session")

    def bound() -> set[str | None]:
        return {peer.ask("zid", "arm-1") for name, peer in net.peers.items() if name != "arm-1"}

    # A bridge may receive a heartbeat over the broker first, where peers have no session.
    seen = eventually(lambda: (messages := bound()) and None not in messages and messages)
    assert len(seen) == 1
    assert net.peers["console"].ask("zid", "sim-1") not in seen


def test_living_peers_name_cannot_be_taken(net: Network) -> None:
    mallory, sim = net.stranger("impostor"), net.peers["sim-1"]
    before = sim.ask("zid", "arm-1"), sim.ask("cert", "arm-1")
    for number in range(30):
        body = {"robot_id": "arm-1", "robot_type": "impostor", "hostname": "elsewhere", "timestamp": time.time()}
        mallory.put(f"strands/{('arm-1', 'impostor')[number % 2]}/presence", body)
        row = next(row for row in sim.ask("peers") if row["peer_id"] == "arm-1")
        assert row["type"] == "robot"
        time.sleep(0.01)
    assert (sim.ask("zid", "arm-1"), sim.ask("cert", "arm-1")) == before
    assert sim.ask("ping", "arm-1")["status"] == "ok"


# Asking.


def test_a_ping_is_answered_and_timed(net: Network) -> None:
    answer = net.peers["console"].ask("ping", "arm-1")
    assert answer["status"] == "ok"
    assert answer["via"] == ("direct" if net.kind == "mqtt" else "publish")
    assert answer["confirmed"] is (net.kind == "mqtt")
    assert answer["latency_ms"] > 0


def test_absent_peer_is_offline_at_once(net: Network) -> None:
    net.needs("confirm")
    assert net.peers["console"].ask("ping", "absent")["status"] == "offline"


def test_absent_peer_times_out(net: Network) -> None:
    answer = net.peers["console"].ask("send", "absent", {"action": "status"}, 0.2)
    assert answer.get("status") == "timeout" or answer.get("error") == "offline"


@pytest.mark.parametrize("target", ["arm-1", "sim-1"])
@pytest.mark.parametrize("action", ["status", "state", "features"])
def test_reads_are_answered(net: Network, target: str, action: str) -> None:
    reply = net.peers["console"].ask("send", target, {"action": action}, 20)
    assert (reply["type"], reply["responder_id"]) == ("response", target)
    assert reply["result"]["status"] == "success"


def test_a_simulation_starts_and_stops_on_demand(net: Network) -> None:
    console, sim = net.peers["console"], net.peers["sim-1"]
    assert console.ask("send", "sim-1", WAVE, 20)["result"]["status"] == "success"
    assert sim.ask("moving") == ["left"]
    result = console.ask("send", "sim-1", {"action": "stop"}, 20)["result"]
    assert result.pop("statement")["ok"] is True
    assert result == {"ok": True, "stopped": ["left"], "not_stopped": [], "results": {"left": "stopped"}}
    assert sim.ask("moving") == []


def test_tell_runs_an_approved_arm_and_waits_for_its_end(net: Network) -> None:
    reply = net.peers["console"].ask("tell", "arm-1", "wave", 0.5)
    assert reply["result"]["task_status"] == "idle"


def test_an_arm_obeys_nobody_without_approval(net: Network) -> None:
    reply = net.peers["console"].ask("send", "arm-1", {"action": "acquireControl"}, 20)
    assert reply["type"] == "error"
    assert "operator approval" in reply["error"]


def test_a_verb_that_an_arm_lacks_is_refused_without_a_word_of_approval(net: Network) -> None:
    reply = net.peers["console"].ask("send", "arm-1", {"action": "reset"}, 20)
    assert reply["result"]["status"] == "error"
    assert reply["result"]["reason"].startswith("reset is refused: arm-1 lacks what it needs")


def test_a_broadcast_collects_every_peer(net: Network) -> None:
    def answered() -> bool:
        replies = net.peers["console"].ask("broadcast", {"action": "ping"}, 0.7)
        names = [reply["responder_id"] for reply in replies]
        assert len(names) == len(set(names)), names
        return set(names) == {"arm-1", "sim-1"}

    eventually(answered)


# Publishing.


def test_published_message_is_received_until_unsubscribed(net: Network) -> None:
    console, sim = net.peers["console"], net.peers["sim-1"]
    assert console.ask("hear", "strands/*/notes", None, "notes") == "notes"

    def received() -> list[Any]:
        sim.ask("publish", "strands/sim-1/notes", {"text": "good morning"})
        messages: list[Any] = console.ask("received", "notes")
        return messages

    assert eventually(received)[0] == {"key": "strands/sim-1/notes", "text": "good morning"}
    console.ask("deaf", "notes")
    sim.ask("publish", "strands/sim-1/notes", {"text": "good night"})
    assert console.ask("received", "notes") == []


def test_a_message_too_large_is_an_error_to_its_sender(net: Network) -> None:
    with pytest.raises(RuntimeError, match="16384"):
        net.peers["console"].ask("publish", "strands/sim-1/cmd", {"text": "x" * 16384})


def test_the_state_of_a_robot_and_of_a_world_is_published(net: Network) -> None:
    console = net.peers["console"]
    console.ask("hear", "strands/*/state", None, "states")

    def by_peer() -> dict[str, Any] | None:
        messages = {each["peer_id"]: each for each in console.ask("received", "states")}
        return messages if len(messages) >= 2 else None

    messages = eventually(by_peer) or {}
    console.ask("deaf", "states")
    assert messages["arm-1"]["joints"] == {"shoulder": 1.5}
    assert messages["sim-1"]["sim_time"] == 1.25
    assert abs(messages["sim-1"]["t"] - time.time()) < 10


def test_a_policys_steps_are_streamed(net: Network) -> None:
    console, sim = net.peers["console"], net.peers["sim-1"]
    console.ask("hear", "strands/sim-1/stream", None, "steps")

    def received() -> list[Any]:
        sim.ask("step", 7)
        messages: list[Any] = console.ask("received", "steps")
        return messages

    step = eventually(received)[0]
    console.ask("deaf", "steps")
    assert (step["peer_id"], step["step"], step["instruction"], step["policy"]) == ("sim-1", 7, "wave", "mock")
    assert step["action"] == {"joint": 0.6}


# Leading and following.


def test_a_leader_moves_its_follower_in_order_until_a_stop(net: Network) -> None:
    net.needs("input")
    console, arm = net.peers["console"], net.peers["arm-1"]
    before = len(arm.ask("actions"))
    eventually(lambda: arm.ask("follow", "console") is None, what="the leader has announced itself")
    console.ask("lead")
    eventually(lambda: len(arm.ask("actions")) - before >= 15)
    moved = [action["shoulder.pos"] for action in arm.ask("actions")[before:]]
    assert moved == sorted(moved)
    stats = arm.ask("followed")
    assert (stats["rejected"], stats["errors"], stats["out_of_order"]) == (0, 0, 0)
    console.ask("send", "arm-1", {"action": "stop"}, 20)
    eventually(lambda: arm.ask("followed")["running"] is False)
    # The leader goes on. The follower takes one frame at a time, so with one refused none is being applied.
    eventually(lambda: arm.ask("followed")["rejected_lockout"], what="a frame after the stop")
    still = len(arm.ask("actions"))
    time.sleep(0.1)
    assert len(arm.ask("actions")) == still
    assert console.ask("rest")["thread_alive"] is False
    assert arm.ask("unfollow")["running"] is False


def test_a_leaders_pause_ends_no_stream(net: Network) -> None:
    net.needs("input")
    console, arm = net.peers["console"], net.peers["arm-1"]
    eventually(lambda: arm.ask("follow", "console") is None, what="the leader has announced itself")
    console.ask("lead")
    eventually(lambda: arm.ask("followed")["frames_received"] > 5, what="frames")
    console.ask("rest")
    paused = time.monotonic()
    eventually(lambda: arm.ask("followed")["holding"], what="the hold")
    eventually(lambda: time.monotonic() > paused + 1.5 * LOST_S, what="a pause beyond every bound")
    before = arm.ask("followed")
    assert before["running"]
    console.ask("lead")
    eventually(lambda: arm.ask("followed")["frames_received"] > before["frames_received"] + 5, what="frames again")
    assert not arm.ask("followed")["holding"]
    console.ask("rest")
    assert arm.ask("unfollow")["running"] is False


def test_frames_of_another_session_move_nothing(net: Network) -> None:
    net.needs("input")
    arm, mallory = net.peers["arm-1"], net.stranger("puppeteer")
    before = len(arm.ask("actions"))
    assert arm.ask("follow", "console") is None
    frame = {"peer_id": "console", "device": "leader", "method": "arm", "t": time.time(), "seq": 10**6}

    def refused() -> int:
        mallory.put("strands/console/input/leader", {**frame, "action": {"shoulder.pos": 90.0}})
        count: int = arm.ask("followed")["rejected_source"]
        return count

    eventually(refused)
    assert arm.ask("unfollow")["running"] is False
    assert len(arm.ask("actions")) == before


# Messages in another peer's name.


def test_a_command_in_anothers_name_does_not_move_an_arm(net: Network) -> None:
    mallory, arm = net.stranger("forger"), net.peers["arm-1"]
    messages = replies_to(mallory, "console")
    reply = until_answered(mallory, "strands/arm-1/cmd", request("console", WAVE), messages)
    assert "operator approval" in reply["error"]
    assert arm.ask("moving") is False


def test_a_command_is_carried_out_once(net: Network) -> None:
    mallory, sim = net.stranger("repeater"), net.peers["sim-1"]
    messages = replies_to(mallory, "repeater")
    until_answered(mallory, "strands/sim-1/cmd", request("repeater", {"action": "ping"}), messages)
    before, step = sim.ask("steps"), request("repeater", {"action": "step", "steps": 3})
    for _ in range(3):
        mallory.put("strands/sim-1/cmd", step)
    # The bridge takes a command that comes again for the other leg's copy and does not even answer it.
    again = [] if net.kind == "bridge" else ["replay rejected", "replay rejected"]

    def answers() -> list[str]:
        # A ping that was sent more than once may still be answered meanwhile.
        return sorted(reply.get("error", "") for reply in list(messages) if reply["turn_id"] == step["turn_id"])

    eventually(lambda: len(answers()) >= 1 + len(again))
    assert answers() == ["", *again]
    assert sim.ask("steps") == before + 3


@pytest.mark.parametrize("shift", [-61.0, 60.0])
def test_motion_with_a_wrong_time_is_refused(net: Network, shift: float) -> None:
    mallory, sim = net.stranger("late" if shift < 0 else "early"), net.peers["sim-1"]
    sender, before = "late" if shift < 0 else "early", sim.ask("steps")
    messages = replies_to(mallory, sender)
    stale = request(sender, {"action": "step"}, timestamp=time.time() + shift)
    assert until_answered(mallory, "strands/sim-1/cmd", stale, messages)["error"] == "replay rejected"
    assert sim.ask("steps") == before


def test_a_command_out_of_bounds_is_answered_with_the_reason(net: Network) -> None:
    mallory = net.stranger("careless")
    messages = replies_to(mallory, "careless")
    body = request("careless", {**WAVE, "duration": True})
    reply = until_answered(mallory, "strands/sim-1/cmd", body, messages)
    assert reply["error"].startswith("validation: duration")


# Safety.


def test_emergency_stop_halts_and_locks_every_peer_until_the_signed_resume(net: Network) -> None:
    console, arm, sim = (net.peers[name] for name in ("console", "arm-1", "sim-1"))
    arm.ask("start", "wave")
    sim.ask("start", "wave")
    answers = console.ask("estop")[1]
    assert {answer["responder_id"] for answer in answers} == {"arm-1", "sim-1"}
    epoch = console.ask("epoch")
    assert [peer.ask("epoch") for peer in (arm, sim)] == [epoch, epoch]
    assert arm.ask("moving") is False and sim.ask("moving") == []
    assert console.ask("send", "sim-1", WAVE, 20)["error"] == "command rejected"
    for action in ("status", "state", "features", "teleop_status", "ping", "stop"):
        assert console.ask("send", "sim-1", {"action": action}, 20)["type"] == "response"
    assert console.ask("resume", str(net.folder / "operator.pem"), PASSPHRASE) == {"status": "ok"}
    for peer in (arm, sim):
        eventually(lambda peer=peer: peer.ask("epoch") is None, what=f"{peer.peer_id} is free")
    assert console.ask("send", "sim-1", WAVE, 20)["result"]["status"] == "success"


def test_any_peer_may_stop_and_only_the_operator_may_resume(net: Network, tmp_path: Path) -> None:
    keygen(tmp_path / "own.pem", PASSPHRASE)
    console, arm = net.peers["console"], net.peers["arm-1"]
    arm.ask("estop")
    eventually(lambda: console.ask("epoch"))
    assert console.ask("resume", str(tmp_path / "own.pem"), PASSPHRASE) == {
        "status": "error",
        "error": "resume rejected",
    }
    assert arm.ask("epoch") == console.ask("epoch")


# Last, because its ghost stays listed for a while and every stop would wait for it.


def test_a_reply_in_anothers_name_does_not_count(net: Network) -> None:
    mallory, ghost = net.stranger("liar"), net.stranger("ghost")
    console = net.peers["console"]
    turns: list[str] = []

    def announced() -> bool:
        ghost.put("strands/ghost/presence", {"robot_id": "ghost", "robot_type": "robot", "timestamp": time.time()})
        return "ghost" in console.ask("reachable")

    def answer(sample: Any) -> None:
        turn = json.loads(sample.payload)["turn_id"]
        turns.append(turn)
        body = {"type": "response", "responder_id": "ghost", "turn_id": turn, "result": {}, "timestamp": time.time()}
        mallory.put(f"strands/console/response/ghost/{turn}", body)

    eventually(announced, what="the console knows the ghost's session")
    mallory.declare_subscriber("strands/ghost/cmd", answer)

    def unanswered() -> bool:
        assert announced()
        assert console.ask("send", "ghost", {"action": "ping"}, 0.3).get("type") is None
        return len(turns) >= 2

    eventually(unanswered, what="two commands that the liar answered")
