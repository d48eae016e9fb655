"""Stops over the mesh: of one robot of a world, of what stands in line, and beside a stream that hangs."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.envelope import Envelope, success

START = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 30.0}


class Hanging(Arm):
    """An arm whose bus takes one action and does not come back."""

    def __init__(self) -> None:
        super().__init__()
        self.inside, self.let_go = threading.Event(), threading.Event()

    def send_action(self, action: dict[str, float]) -> Envelope:
        self.inside.set()
        self.let_go.wait(10)
        return success("sent")


def test_a_stop_does_not_wait_for_a_stream_whose_frame_hangs(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    arm = Hanging()
    peers.join(arm, "arm-1")
    console, leader = peers.join(None, "console"), peers.join(None, "lead")
    opened = console.send("arm-1", {"action": "teleop_receive", "source_peer_id": "lead"}, timeout=5)
    assert opened["result"]["status"] == "success"
    frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": peers.clock(), "seq": 1}
    leader.publish("strands/lead/input/leader", {**frame, "action": {"shoulder.pos": 1.0}, "events": None})
    assert arm.inside.wait(5)
    answers: list[Any] = []
    asking = threading.Thread(target=lambda: answers.append(console.send("arm-1", {"action": "stop"}, timeout=8)))
    began = time.monotonic()
    asking.start()
    eventually(lambda: arm.halts, within=2)
    assert time.monotonic() - began < 1.0
    arm.let_go.set()
    asking.join(8)
    assert answers[0]["result"]["ok"] is True


def test_the_stop_of_one_robot_reaches_its_start_that_stands_in_line(peers: Fleet) -> None:
    """Four workers are busy, a start of left and one of right wait; left is stopped; then the workers are free."""
    let_go, begun = threading.Event(), threading.Semaphore(0)

    class Busy(World):
        def step(self, n: int = 1) -> Envelope:
            begun.release()
            let_go.wait(10)
            return success("stepped")

    world = Busy("left", "right")
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    answers: dict[str, Any] = {}

    def ask(name: str, command: dict[str, Any]) -> threading.Thread:
        thread = threading.Thread(target=lambda: answers.update({name: console.send("sim-1", command, timeout=9)}))
        thread.start()
        return thread

    threads = [ask(f"step-{n}", {"action": "step", "steps": 1}) for n in range(4)]
    assert all(begun.acquire(timeout=5) for _ in threads)
    server = peers.meshes[0]._assembled.lanes.commands._queue
    threads += [ask(name, {**START, "robot_name": name}) for name in ("left", "right")]
    eventually(lambda: server.qsize() == 2)
    stopped = console.send("sim-1", {"action": "stop", "robot_name": "left"}, timeout=5)
    assert stopped["result"]["ok"] is True
    let_go.set()
    for thread in threads:
        thread.join(9)
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
    console.send("arm-1", {"action": "teleop_receive", "source_peer_id": "lead"}, timeout=5)
    frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": peers.clock(), "seq": 1}
    leader.publish("strands/lead/input/leader", {**frame, "action": {"shoulder.pos": 1.0}, "events": None})
    assert arm.inside.wait(5)
    asking = threading.Thread(target=lambda: console.send("arm-1", {"action": "stop"}, timeout=8))
    asking.start()
    eventually(lambda: arm.halts, within=2)
    arm.let_go.set()
    asking.join(8)
    eventually(lambda: refused == [True], within=2)
