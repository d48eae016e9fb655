"""Commands from one peer to another, on the in-memory transport."""

from __future__ import annotations

import json
import threading
from importlib.metadata import EntryPoint
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots import plug_ins
from strands_robots.mesh.security import ValidationError, validate_command
from strands_robots.mesh.transport.memory import MemoryTransport
from strands_robots.safety.authorization import Grants
from strands_robots.serving.peer_verbs import PEER_VERBS, run_to_end
from strands_robots.serving.policy_arguments import registered_providers
from strands_robots.serving.robot_verbs import served
from strands_robots.state_files import state_dir


def ask(
    peers: Fleet, transport: MemoryTransport, target: str, body: dict[str, Any], *, sender: str = "console"
) -> list[dict[str, Any]]:
    """Publish a hand-made request and collect what comes back on the sender's response topic."""
    replies: list[dict[str, Any]] = []
    handle = transport.declare_subscriber(
        f"strands/{sender}/response/**", lambda sample: replies.append(json.loads(sample.payload))
    )
    request = {"sender_id": sender, "turn_id": "t1", "timestamp": peers.clock(), **body}
    transport.put(f"strands/{target}/cmd", request)
    eventually(lambda: replies, what="a reply")
    handle.undeclare()
    return replies


def test_a_ping_is_answered_by_the_mesh_alone(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    answer = console.ping("arm-1", timeout=20)
    assert answer["status"] == "ok"
    assert answer["via"] == "publish"
    assert answer["confirmed"] is False
    assert 0 <= answer["latency_ms"] < 20_000


def test_a_peer_that_is_not_there_times_out(peers: Fleet) -> None:
    console = peers.join(None, "console")
    assert console.ping("nobody", timeout=0.1)["status"] == "timeout"


def test_a_simulation_runs_what_it_is_told(peers: Fleet) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    reply = console.send("sim-1", {"action": "start", "instruction": "wave", "policy_provider": "mock"}, timeout=20)
    assert reply["result"]["status"] == "success"
    assert world.running == {"left": "wave"}
    reply = console.send("sim-1", {"action": "stop"}, timeout=20)
    assert reply["result"].pop("statement")["ok"] is True
    assert reply["result"] == {"ok": True, "stopped": ["left"], "not_stopped": [], "results": {"left": "stopped"}}


def test_an_empty_robot_name_is_refused_by_a_world_of_several(peers: Fleet) -> None:
    world = World("left", "right")
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    command = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    assert console.send("sim-1", command, timeout=20)["result"]["status"] == "error"
    assert console.send("sim-1", {**command, "robot_name": "right"}, timeout=20)["result"]["status"] == "success"
    assert world.running == {"right": "wave"}


@pytest.mark.parametrize("action", ["status", "state", "features"])
def test_reads_are_answered_with_the_robots_own_envelope(peers: Fleet, action: str) -> None:
    peers.join(Arm(), "arm-1")
    console = peers.join(None, "console")
    assert console.send("arm-1", {"action": action}, timeout=20)["result"]["status"] == "success"


def test_real_hardware_does_not_move_without_the_operators_approval(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = Arm()
    peers.join(arm, "arm-1")
    console = peers.join(None, "console")
    command = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 0.5}
    reply = console.send("arm-1", command, timeout=20)
    assert reply["type"] == "error"
    assert "operator approval" in reply["error"]
    assert peers.events("wire_motion_refused")
    assert not arm.started
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "start@arm-1")
    assert console.send("arm-1", command, timeout=20)["result"]["status"] == "success"
    assert arm.started == ["wave"]


def test_a_grant_is_not_spent_by_a_sender_that_is_not_attributed(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = Arm()
    peers.join(arm, "arm-1")
    console = peers.join(None, "console")
    Grants(state_dir() / "grants").grant("start", "arm-1")
    command = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 0.5}
    forged = ask(peers, peers.stranger(), "arm-1", {"command": command})
    assert "operator approval" in forged[0]["error"]
    assert not arm.started
    assert console.send("arm-1", command, timeout=20)["result"]["status"] == "success"
    assert "operator approval" in console.send("arm-1", command, timeout=20)["error"]


def test_execute_waits_until_the_policy_has_ended(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    arm = Arm()
    peers.join(arm, "arm-1")
    console = peers.join(None, "console")
    reply = console.tell("arm-1", "wave", policy_provider="mock", duration=0.5)
    assert reply["result"]["task_status"] == "idle"


def test_leaving_the_mesh_ends_an_execute_with_the_reason(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    arm, left = Arm(), threading.Event()
    execute = {"policy_provider": "mock", "policy_host": "localhost", "duration": 30.0}
    answers: list[Any] = []
    asking = threading.Thread(target=lambda: answers.append(run_to_end(served(arm), execute, left.is_set)))
    asking.start()
    eventually(lambda: arm.moving)
    left.set()
    asking.join(20)
    assert answers[0]["status"] == "error"
    assert "left the mesh" in answers[0]["reason"]


def test_a_replayed_motion_is_carried_out_once(peers: Fleet) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    stranger = peers.stranger()
    body = {"command": {"action": "step", "steps": 2}}
    assert "result" in ask(peers, stranger, "sim-1", body)[0]
    assert ask(peers, stranger, "sim-1", body)[0]["error"] == "replay rejected"
    assert world.steps == 2


def test_the_commands_of_a_leader_push_no_turn_of_others_out(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("strands_robots.mesh.commands.REPLAYS_MAX", 4)
    world = World("left")
    peers.join(world, "sim-1", "sim")
    stranger = peers.stranger()
    body = {"command": {"action": "step", "steps": 2}}
    assert "result" in ask(peers, stranger, "sim-1", body)[0]
    for number in range(8):
        lead = {"command": {"action": "leadTo", "lead_id": "x", "seq": number}, "turn_id": f"lead-{number}"}
        assert "result" in ask(peers, stranger, "sim-1", lead)[0]
    assert ask(peers, stranger, "sim-1", body)[0]["error"] == "replay rejected"
    assert world.steps == 2


@pytest.mark.parametrize("shift", [-61.0, 6.0])
def test_a_motion_that_is_stale_or_ahead_is_refused(peers: Fleet, shift: float) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    body = {"command": {"action": "step"}, "timestamp": peers.clock() + shift}
    assert ask(peers, peers.stranger(), "sim-1", body)[0]["error"] == "replay rejected"
    assert world.steps == 0


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (None, "missing or malformed command"),
        ([], "missing or malformed command"),
        ({}, "validation: "),
        ({"action": "fly"}, "validation: "),
        ({"action": "execute"}, "validation: "),
        ({"action": "start", "policy_provider": "mock", "duration": True}, "validation: duration"),
        ({"action": "step", "steps": 2.5}, "validation: steps"),
    ],
)
def test_a_command_out_of_bounds_is_answered_with_the_reason(peers: Fleet, command: object, says: str) -> None:
    peers.join(Arm(), "arm-1")
    reply = ask(peers, peers.stranger(), "arm-1", {"command": command})[0]
    assert reply["type"] == "error"
    assert reply["error"].startswith(says)
    assert reply["responder_id"] == "arm-1"


UNREAD = ("durration", "n_step", "embodiment", "fast_mode", "trust_remote_code", "server_address")


@pytest.mark.parametrize("name", UNREAD)
def test_a_motion_with_a_field_that_no_peer_reads_is_refused_by_name_and_moves_nothing(peers: Fleet, name: str) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    transport = peers.transports["sim-1"]
    for action in ("start", "execute"):
        command = {"action": action, "instruction": "wave", "policy_provider": "mock", name: 1}
        (reply,) = ask(peers, transport, "sim-1", {"turn_id": action, "command": command})
        assert reply["type"] == "error"
        assert f"it has no {name}" in reply["error"]
    assert not world.list_policies_running()


def test_a_motion_takes_what_peers_of_0_5_3_send_with_it(peers: Fleet) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    fields = {"turn_id": "t1", "sender_id": "console", "policy_host": "localhost", "duration": 300.0}
    command = {"action": "start", "instruction": "wave", "policy_provider": "mock", **fields, "world_update": None}
    (reply,) = ask(peers, peers.transports["sim-1"], "sim-1", {"command": command})
    assert reply["result"]["status"] == "success", reply
    assert world.list_policies_running()


@pytest.mark.parametrize("action", ["status", "features", "state", "stop", "ping", "teleop_status", "teleop_stop"])
def test_reads_and_stops_ignore_a_field_that_they_do_not_have(peers: Fleet, action: str) -> None:
    peers.join(World("left"), "sim-1", "sim")
    (reply,) = ask(peers, peers.transports["sim-1"], "sim-1", {"command": {"action": action, "durration": 1}})
    assert reply["type"] == "response", reply


@pytest.mark.parametrize("sender", ["", "*", "a/b", "**", None, 7])
def test_a_sender_that_is_no_identifier_gets_no_reply(peers: Fleet, sender: object) -> None:
    peers.join(Arm(), "arm-1")
    heard: list[str] = []
    stranger = peers.stranger()
    stranger.declare_subscriber("strands/*/response/**", lambda sample: heard.append(sample.key))
    stranger.put("strands/arm-1/cmd", {"sender_id": sender, "turn_id": "t", "command": {"action": "ping"}})
    eventually(lambda: peers.events("command_rejected"))
    assert not heard


def test_what_a_robot_raises_does_not_leave_the_process(peers: Fleet) -> None:
    class Broken(Arm):
        def get_task_status(self) -> dict[str, Any]:
            raise RuntimeError("secret path /home/someone")

    peers.join(Broken(), "arm-1")
    console = peers.join(None, "console")
    reply = console.send("arm-1", {"action": "status"}, timeout=20)
    assert reply["error"] == "dispatch error"
    assert "secret" not in json.dumps(reply)


def test_a_full_queue_answers_busy_and_stop_and_ping_still_work(peers: Fleet) -> None:
    release = threading.Event()

    class Slow(Arm):
        def get_features(self) -> dict[str, Any]:
            release.wait(60)
            return super().get_features()

    arm = Slow()
    mesh = peers.join(None, "console")
    peers.join(arm, "arm-1")
    stranger = peers.stranger()
    errors: list[str] = []
    stranger.declare_subscriber(
        "strands/flood/response/**", lambda sample: errors.append(json.loads(sample.payload).get("error", ""))
    )
    for turn in range(60):
        body = {"sender_id": "flood", "turn_id": f"t{turn}", "command": {"action": "features"}}
        stranger.put("strands/arm-1/cmd", body)
    assert "busy" in errors
    assert mesh.ping("arm-1", timeout=20)["status"] == "ok"
    assert mesh.send("arm-1", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    release.set()


def test_a_stop_reaches_the_commands_that_still_wait_for_their_turn(peers: Fleet) -> None:
    release = threading.Event()

    class Slow(World):
        def reset(self) -> dict[str, Any]:
            release.wait(60)
            return super().reset()

    world = Slow("left")
    console = peers.join(None, "console")
    peers.join(world, "sim-1", "sim")
    stranger = peers.stranger()
    results: dict[str, Any] = {}

    def heard(sample: Any) -> None:
        reply = json.loads(sample.payload)
        results[reply["turn_id"]] = reply["result"]

    stranger.declare_subscriber("strands/agent/response/**", heard)
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    for turn, command in enumerate([{"action": "reset"}] * 4 + [start]):
        body = {"sender_id": "agent", "turn_id": f"t{turn}", "timestamp": peers.clock(), "command": command}
        stranger.put("strands/sim-1/cmd", body)
    assert console.send("sim-1", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    release.set()
    eventually(lambda: "t4" in results)
    assert "halted after it was asked for" in results["t4"]["reason"]
    assert world.running == {}


def test_a_refused_precondition_leaves_nothing_on_the_wire(peers: Fleet) -> None:
    console = peers.join(None, "console")
    for target in ("", "a\x00b", None, 5, "a/b", "*"):
        assert console.send(target, {"action": "ping"}, timeout=1)["status"] == "error"  # type: ignore[arg-type]
    for timeout in (0, -1, float("nan"), float("inf"), True, "1"):
        assert console.send("arm-1", {"action": "ping"}, timeout=timeout)["status"] == "error"  # type: ignore[arg-type]
    assert console.send("arm-1", {"action": "execute"}, timeout=1)["status"] == "error"
    assert console.broadcast({"action": "fly"}, timeout=1) == []
    console.stop()
    assert console.send("arm-1", {"action": "ping"}, timeout=1)["status"] == "error"
    assert console.broadcast({"action": "ping"}, timeout=1) == []


def test_a_broadcast_collects_every_peer(peers: Fleet) -> None:
    for number in range(3):
        peers.join(Arm(), f"arm-{number}")
    console = peers.join(None, "console")

    def answered() -> list[str]:
        return sorted(reply["responder_id"] for reply in console.broadcast({"action": "ping"}, timeout=0.3))

    eventually(lambda: answered() == ["arm-0", "arm-1", "arm-2"], what="one answer of each peer")


def answering(peers: Fleet, transport: MemoryTransport, *, key: str, responder: str, times: int = 1) -> None:
    """Have a session answer every command to arm-1 in somebody's name."""

    def answer(sample: Any) -> None:
        turn = json.loads(sample.payload)["turn_id"]
        body = {"type": "response", "responder_id": responder, "turn_id": turn, "result": {"forged": True}}
        for _ in range(times):
            transport.put(key.format(turn=turn), body)

    transport.declare_subscriber("strands/arm-1/cmd", answer)


@pytest.mark.parametrize(
    ("key", "responder"),
    [
        ("strands/console/response/arm-1/{turn}", "arm-1"),
        ("strands/console/response/{turn}", "arm-1"),
        ("strands/console/response/other/{turn}", "arm-1"),
        ("strands/console/response/arm-1/another", "arm-1"),
        ("strands/console/response/stranger/{turn}", "stranger"),
    ],
)
def test_a_forged_reply_never_counts(peers: Fleet, key: str, responder: str) -> None:
    console = peers.join(None, "console")
    stranger = peers.stranger()
    answering(peers, stranger, key=key, responder=responder)
    # A presence in the name of arm-1 from its own session, as the robot once sent; the robot itself is silent.
    robot = peers.stranger()
    robot.put("strands/arm-1/presence", {"robot_id": "arm-1", "timestamp": peers.clock()})
    assert console.peer_wire_zid("arm-1") == robot.session_id
    assert console.send("arm-1", {"action": "ping"}, timeout=0.2)["status"] == "timeout"
    assert peers.events("response_hijack_rejected")


def test_a_second_reply_of_one_peer_is_dropped(peers: Fleet) -> None:
    console = peers.join(None, "console")
    robot = peers.stranger()
    robot.put("strands/arm-1/presence", {"robot_id": "arm-1", "timestamp": peers.clock()})

    def answer(sample: Any) -> None:
        turn = json.loads(sample.payload)["turn_id"]
        body = {"type": "response", "responder_id": "arm-1", "turn_id": turn, "result": {}}
        for _ in range(2):
            robot.put(f"strands/console/response/arm-1/{turn}", body)

    robot.declare_subscriber("strands/broadcast", answer)
    assert len(console.broadcast({"action": "ping"}, timeout=0.1)) == 1
    assert peers.events("response_duplicate_rejected")


def test_without_sessions_a_reply_is_the_brokers_word(peers: Fleet) -> None:
    peers.join(World("left"), "sim-1", "sim", sessionless=True)
    console = peers.join(None, "console", sessionless=True)
    assert console.ping("sim-1", timeout=20)["status"] == "ok"


@pytest.mark.parametrize("command", [{"action": "stop", "duration": -1}, {"action": "teleop_stop", "steps": 2.5}])
def test_what_takes_energy_away_is_refused_for_no_field_that_it_does_not_use(
    peers: Fleet, command: dict[str, Any]
) -> None:
    peers.join(Arm(), "arm-1")
    reply = ask(peers, peers.stranger(), "arm-1", {"command": command})[0]
    assert reply["type"] == "response"


@pytest.mark.parametrize("name", ["a/b", "x" * 10_000, 5, True, ["left"], {"left": [[]]}, None])
def test_a_stop_whose_name_cannot_be_read_stops_the_whole_world(peers: Fleet, name: object) -> None:
    peers.join(World("left"), "sim-1", "sim")
    console = peers.join(None, "console")
    command = {"action": "stop", "robot_name": name, "reason": "x" * 1000, "other": [[]]}
    for reply in (ask(peers, peers.stranger(), "sim-1", {"command": command})[0], console.send("sim-1", command, 20)):
        assert reply["type"] == "response", reply
        assert reply["result"]["ok"] is True


@pytest.mark.parametrize("action", ["stop", "teleop_stop"])
def test_what_takes_energy_away_asks_for_no_clock_and_is_done_again(peers: Fleet, action: str) -> None:
    peers.join(Arm(), "arm-1")
    for shift in (-3600, 3600, 0, 0):
        body = {"command": {"action": action}, "timestamp": peers.clock() + shift}
        assert ask(peers, peers.stranger(), "arm-1", body)[0]["type"] == "response"


def test_a_plug_ins_policy_is_known_on_the_wire(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    start = {"action": "start", "instruction": "wave", "policy_provider": "house_made"}
    refused = console.send("sim-1", start, timeout=20)
    assert refused["error"].startswith("validation: policy_provider must be one of")
    entry = EntryPoint("house_made", "house:Made", "strands_robots.policies")
    monkeypatch.setattr(plug_ins, "entry_points", lambda group: [entry])
    registered_providers.cache_clear()
    try:
        assert console.send("sim-1", start, timeout=20)["result"]["status"] == "success"
    finally:
        registered_providers.cache_clear()


@pytest.mark.parametrize("name", ["pi0", "groot", "cosmos3", "smolvla"])
def test_a_provider_of_other_builds_validates(name: str) -> None:
    assert validate_command({"action": "start", "policy_provider": name})["policy_provider"] == name


@pytest.mark.parametrize("action", ["start", "execute", "lead"])
def test_a_robot_has_the_providers_that_its_operator_lists_and_its_sender_has_others(
    monkeypatch: pytest.MonkeyPatch, action: str
) -> None:
    def at_the_robot(provider: str) -> object:
        return PEER_VERBS[action].checked({"policy_provider": provider})["policy_provider"]

    with pytest.raises(ValidationError) as refused:
        at_the_robot("own")
    assert refused.value.code == "POLICY_TYPE_NOT_ALLOWED"
    assert validate_command({"action": action, "policy_provider": "own"})["policy_provider"] == "own"
    with pytest.raises(ValidationError, match="policy_provider"):
        validate_command({"action": action, "policy_provider": "../own"})
    monkeypatch.setenv("STRANDS_MESH_POLICY_TYPE_ALLOW", "own")
    assert at_the_robot("own") == "own"
    with pytest.raises(ValidationError):
        at_the_robot("pi0")


@pytest.mark.parametrize("action", ["start", "execute"])
def test_a_task_without_a_policy_is_refused_before_it_is_sent(action: str) -> None:
    for given in ({}, {"policy_provider": ""}):
        with pytest.raises(ValidationError, match="policy_provider"):
            validate_command({"action": action, **given})
