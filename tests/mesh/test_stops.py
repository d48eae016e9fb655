"""Stops over the mesh: of one robot of a world, of commands that wait, and beside a stream that hangs."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.envelope import Envelope, success
from strands_robots.mesh import input_receiver, rpc
from strands_robots.mesh.input_receiver import InputReceiver
from strands_robots.mesh.transport import MemoryTransport
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.stops import CALLER_MAX
from strands_robots.serving.workers import shares_of

START = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 30.0}


class Hanging(Arm):
    """An arm whose bus takes one action and does not come back."""

    def __init__(self) -> None:
        super().__init__()
        self.inside, self.let_go = threading.Event(), threading.Event()

    def send_action(self, action: dict[str, float]) -> Envelope:
        self.inside.set()
        self.let_go.wait(60)
        return success("sent")


def test_a_stop_does_not_wait_for_a_stream_whose_frame_hangs(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    monkeypatch.setattr(input_receiver, "JOIN_S", 60.0)
    arm = Hanging()
    peers.join(arm, "arm-1")
    console, leader = peers.join(None, "console"), peers.join(None, "lead")
    opened = console.send("arm-1", {"action": "teleop_receive", "source_peer_id": "lead"}, timeout=20)
    assert opened["result"]["status"] == "success"
    frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": peers.clock(), "seq": 1}
    leader.publish(
        "strands/lead/input/leader", leader.inputs.sign({**frame, "action": {"shoulder.pos": 1.0}, "events": None})
    )
    assert arm.inside.wait(20)
    answers: list[Any] = []
    asking = threading.Thread(target=lambda: answers.append(console.send("arm-1", {"action": "stop"}, timeout=20)))
    asking.start()
    eventually(lambda: arm.halts, what="the halt, while a frame hangs")
    arm.let_go.set()
    asking.join(20)
    assert answers[0]["result"]["ok"] is True


def test_a_stop_is_answered_while_the_frames_of_every_stream_hang(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    monkeypatch.setattr(input_receiver, "JOIN_S", 0.1)
    waited, join = list[str](), InputReceiver.join

    def noting(receiver: InputReceiver, timeout: float) -> bool:
        waited.append(threading.current_thread().name)
        return join(receiver, timeout)

    monkeypatch.setattr(InputReceiver, "join", noting)
    arm = Hanging()
    peers.join(arm, "arm-1")
    console, leader = peers.join(None, "console"), peers.join(None, "lead")
    for device in ("leader", "pedal"):
        receive = {"action": "teleop_receive", "source_peer_id": "lead", "device_name": device}
        assert console.send("arm-1", receive, timeout=20)["result"]["status"] == "success"
        frame = {"peer_id": "lead", "device": device, "method": "arm", "t": peers.clock(), "seq": 1}
        leader.publish(
            f"strands/lead/input/{device}",
            leader.inputs.sign({**frame, "action": {"shoulder.pos": 1.0}, "events": None}),
        )
        assert arm.inside.wait(20)
        arm.inside.clear()
    assert console.send("arm-1", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    assert console.send("arm-1", {"action": "teleop_status"}, timeout=20)["result"]["streams"] == []
    assert console.send("arm-1", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    eventually(lambda: sum("still being applied" in each.getMessage() for each in list(caplog.records)) == 2)
    assert not any(name.startswith("halt-") for name in waited), "no stop waits for a frame"
    arm.let_go.set()


class Slow(World):
    """A world whose halt takes a while."""

    def __init__(self, *names: str) -> None:
        super().__init__(*names)
        self.let_go, self.halting = threading.Event(), threading.Semaphore(0)
        self.halts = 0

    def halt(self, reason: str = "") -> StopVerdict:
        self.halts += 1
        self.halting.release()
        self.let_go.wait(60)
        return super().halt(reason)


def test_no_stop_of_a_flood_is_refused_and_an_honest_one_gets_its_verdict(peers: Fleet) -> None:
    world = Slow("left", "right")
    peers.join(world, "sim-1", "sim")
    console, flood = peers.join(None, "console"), peers.stranger()
    said: dict[str, list[Any]] = {}

    def heard(sample: Any) -> None:
        reply = json.loads(sample.payload)
        said.setdefault(sample.key.split("/")[1], []).append(reply.get("result") or reply)

    flood.declare_subscriber("strands/*/response/**", heard)
    head = {"timestamp": peers.clock()}

    def pour(first: int) -> None:
        for turn in range(first, first + 1000):
            body = {**head, "sender_id": "flood", "turn_id": f"t{turn}", "command": {"action": "stop"}}
            flood.put("strands/sim-1/cmd", body)

    pour(0)
    assert world.halting.acquire(timeout=20)
    answers: list[Any] = []
    commands = [{"action": "stop"}, {"action": "stop", "robot_name": "left"}]
    asking = [
        threading.Thread(target=lambda command=command: answers.append(console.send("sim-1", command, timeout=20)))
        for command in commands
    ]
    for thread in asking:
        thread.start()
    mesh = peers.meshes[0]
    # The stop of one robot waits for no halt of the whole world.
    eventually(lambda: mesh.stops_waiting == CALLER_MAX + 1 and len(answers) == 1)
    pour(1000)
    assert mesh.stops_waiting <= CALLER_MAX + len(commands)
    world.let_go.set()
    for thread in asking:
        thread.join(20)
    assert [answer["result"]["ok"] for answer in answers] == [True, True]
    eventually(lambda: mesh.stops_waiting == 0)
    assert all(each["ok"] is True for each in said["flood"])
    assert world.halts <= 4


def test_a_stop_of_an_unknown_robot_is_answered_at_once_and_halts_nothing(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rpc, "REPEAT_S", 60.0)
    world, arm = Slow("left", "right"), Arm()
    for robot, name in ((world, "sim-1"), (arm, "arm-1")):
        peers.join(robot, name, "sim")
    console, flood = peers.join(None, "console"), peers.stranger()
    said: list[dict[str, Any]] = []
    flood.declare_subscriber("strands/flood/response/sim-1/*", lambda each: said.append(json.loads(each.payload)))
    asking = threading.Thread(target=lambda: console.send("sim-1", {"action": "stop"}, timeout=60))
    asking.start()
    assert world.halting.acquire(timeout=20)
    for turn in range(300):
        command = {"action": "stop", "robot_name": f"robot-{turn}"}
        for name in ("sim-1", "arm-1"):
            flood.put(f"strands/{name}/cmd", {"sender_id": "flood", "turn_id": f"t{turn}", "command": command})
    assert len(said) == 300, "an unknown name is answered while a halt is carried out"
    assert said[0]["result"]["ok"] is False
    assert "the robots here are left, right" in said[0]["result"]["error"]
    assert peers.meshes[0].stops_waiting == 1
    world.let_go.set()
    asking.join(60)
    assert world.halts == 1
    assert console.send("arm-1", {"action": "stop", "robot_name": "whatever"}, timeout=20)["result"]["ok"] is True


def test_a_stop_that_did_not_stop_is_refused_on_record_and_told_at_critical(
    peers: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    peers.join(Arm("gripper", stops=False), "arm-1")
    console = peers.join(None, "console")
    assert console.send("arm-1", {"action": "stop"}, timeout=20)["result"]["ok"] is False
    eventually(lambda: peers.events("command_refused"))
    assert "gripper: the brake is stuck" in peers.events("command_refused")[0]["reason"]
    assert peers.events("command_executed") == []
    loud = [record.getMessage() for record in list(caplog.records) if record.levelname == "CRITICAL"]
    assert len(loud) == 1
    assert "arm-1" in loud[0]
    assert "gripper: the brake is stuck" in loud[0]


def test_the_stop_of_one_robot_reaches_its_start_that_stands_in_line(peers: Fleet) -> None:
    """Four workers are busy, a start of left and one of right wait; left is stopped; then the workers are free."""
    let_go, begun = threading.Event(), threading.Semaphore(0)

    class Busy(World):
        def step(self, n: int = 1) -> Envelope:
            begun.release()
            let_go.wait(60)
            return success("stepped")

    world = Busy("left", "right")
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    answers: dict[str, Any] = {}

    def ask(name: str, command: dict[str, Any]) -> threading.Thread:
        thread = threading.Thread(target=lambda: answers.update({name: console.send("sim-1", command, timeout=20)}))
        thread.start()
        return thread

    threads = [ask(f"step-{n}", {"action": "step", "steps": 1}) for n in range(4)]
    assert all(begun.acquire(timeout=20) for _ in threads)
    threads += [ask(name, {**START, "robot_name": name}) for name in ("left", "right")]
    eventually(lambda: shares_of(world).motion.waiting == 2)
    stopped = console.send("sim-1", {"action": "stop", "robot_name": "left"}, timeout=20)
    assert stopped["result"]["ok"] is True
    let_go.set()
    for thread in threads:
        thread.join(20)
    assert answers["left"]["result"]["status"] == "error"
    assert "halted after it was asked for" in answers["left"]["result"]["reason"]
    assert list(world.running) == ["right"]


def test_a_frame_that_waits_for_the_bus_is_refused_after_a_stop(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    refused: list[bool] = []

    class Late(Hanging):
        def send_action(self, action: dict[str, float]) -> Envelope:
            super().send_action(action)
            refused.append(self.gate.refusal("send_action") is not None)
            return success("asked")

    arm = Late()
    peers.join(arm, "arm-1")
    console, leader = peers.join(None, "console"), peers.join(None, "lead")
    console.send("arm-1", {"action": "teleop_receive", "source_peer_id": "lead"}, timeout=20)
    frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": peers.clock(), "seq": 1}
    leader.publish(
        "strands/lead/input/leader", leader.inputs.sign({**frame, "action": {"shoulder.pos": 1.0}, "events": None})
    )
    assert arm.inside.wait(20)
    asking = threading.Thread(target=lambda: console.send("arm-1", {"action": "stop"}, timeout=20))
    asking.start()
    eventually(lambda: arm.halts)
    arm.let_go.set()
    asking.join(20)
    eventually(lambda: refused == [True])


def test_thread_of_the_records_of_a_stop_stands_ready_before_the_first_one(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MemoryTransport, "stops_apart", True)
    before = [thread.name for thread in threading.enumerate()].count("mesh-stops")
    peers.join(Arm(), "arm-1")
    assert [thread.name for thread in threading.enumerate()].count("mesh-stops") == before + 1
