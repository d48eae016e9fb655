"""Each robot of a world of several as a peer of its own."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from fixtures.mesh_robots import World
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.envelope import Envelope, success
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.presence import DESCRIBE_S
from strands_robots.mesh.transport.memory import MemoryTransport
from strands_robots.serving.workers import shares_of
from strands_robots.simulation import Simulation

START = {"action": "start", "instruction": "wave", "policy_provider": "mock"}


def joined(peers: Fleet) -> tuple[World, Mesh, Mesh]:
    world = World("left", "right")
    mesh = peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    eventually(lambda: {"sim-1", "sim-1__left", "sim-1__right"} <= set(console.peers_by_id))
    return world, mesh, console


def test_each_robot_of_a_world_is_announced_and_answers_for_itself(peers: Fleet) -> None:
    world, _, console = joined(peers)
    row = console.peers_by_id["sim-1__left"]
    assert (row["type"], row["tool_name"], row["sim_robots"]) == ("sim", "left", ["left"])
    assert console.peer_wire_zid("sim-1__left") == console.peer_wire_zid("sim-1")
    assert console.ping("sim-1__right", timeout=20)["status"] == "ok"
    assert console.send("sim-1__left", START, timeout=20)["result"]["status"] == "success"
    assert world.running == {"left": "wave"}
    status = console.send("sim-1__right", {"action": "status"}, timeout=20)["result"]
    assert (status["task_status"], status["robots"]) == ("idle", ["right"])
    assert list(console.send("sim-1__left", {"action": "state"}, timeout=20)["result"]["robots"]) == ["left"]


def test_the_stop_of_a_child_stops_its_robot_alone(peers: Fleet) -> None:
    world, _, console = joined(peers)
    for name in ("left", "right"):
        console.send(f"sim-1__{name}", START, timeout=20)
    stopped = console.send("sim-1__left", {"action": "stop"}, timeout=20)["result"]
    assert (stopped["ok"], stopped["stopped"]) == (True, ["left"])
    assert world.running == {"right": "wave"}


class Led(World):
    """A world that takes actions; while its bus is held, an action waits for it."""

    def __init__(self, *names: str) -> None:
        super().__init__(*names)
        self.asked, self.free = threading.Semaphore(0), threading.Event()
        self.free.set()
        self.sent: list[bool] = []

    def send_action(self, action: dict[str, float]) -> Envelope:
        self.asked.release()
        self.free.wait(60)
        refusal = self.gate.refusal("send_action")
        self.sent.append(refusal is None)
        return refusal or success("sent")

    def step(self, n: int = 1) -> Envelope:
        self.asked.release()
        self.free.wait(60)
        return super().step(n)


def test_the_stop_of_a_child_ends_the_streams_that_drive_its_world(peers: Fleet) -> None:
    world = Led("left", "right")
    _, console, lead = peers.join(world, "sim-1", "sim"), peers.join(None, "console"), peers.join(None, "lead")
    eventually(lambda: "sim-1__left" in console.peers_by_id)
    receive = {"action": "teleop_receive", "source_peer_id": "lead"}
    assert console.send("sim-1", receive, timeout=20)["result"]["status"] == "success"

    def lead_on(sequence: int) -> None:
        frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": peers.clock(), "seq": sequence}
        lead.publish("strands/lead/input/leader", {**frame, "action": {"pan": 1.0}, "events": None})

    lead_on(1)
    eventually(lambda: world.sent == [True])
    world.free.clear()
    lead_on(2)
    assert world.asked.acquire(timeout=20)
    assert world.asked.acquire(timeout=20)
    assert console.send("sim-1__left", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    assert console.send("sim-1", {"action": "teleop_status"}, timeout=20)["result"]["streams"] == []
    lead_on(3)
    world.free.set()
    eventually(lambda: world.sent == [True, False], what="the frame that waited for the bus to be refused")


@pytest.mark.parametrize("stopped", ["sim-1__left", "sim-1"])
def test_the_stop_of_one_robot_reaches_its_starts_in_line_wherever_they_were_asked_for(
    peers: Fleet, stopped: str
) -> None:
    world = Led("left", "right")
    _, console = peers.join(world, "sim-1", "sim"), peers.join(None, "console")
    eventually(lambda: {"sim-1__left", "sim-1__right"} <= set(console.peers_by_id))
    world.free.clear()
    answers: dict[str, Any] = {}

    def ask(name: str, peer: str, command: dict[str, Any]) -> threading.Thread:
        thread = threading.Thread(target=lambda: answers.update({name: console.send(peer, command, timeout=20)}))
        thread.start()
        return thread

    threads = [ask(f"step-{n}", "sim-1", {"action": "step", "steps": 1}) for n in range(4)]
    assert all(world.asked.acquire(timeout=20) for _ in threads)
    threads += [ask(name, f"sim-1__{name}", START) for name in ("left", "right")]
    threads.append(ask("by name", "sim-1", {**START, "robot_name": "left"}))
    eventually(lambda: shares_of(world).motion.waiting == 3)
    stop = {"action": "stop", **({"robot_name": "left"} if stopped == "sim-1" else {})}
    assert console.send(stopped, stop, timeout=20)["result"]["ok"] is True
    world.free.set()
    for thread in threads:
        thread.join(20)
    assert [answers[name]["result"]["status"] for name in ("left", "by name", "right")] == ["error", "error", "success"]
    assert list(world.running) == ["right"]


def test_a_fleets_stop_of_one_name_leaves_the_robots_of_others_alone(peers: Fleet) -> None:
    world = ToyWorld()
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    eventually(lambda: {"sim-1__left", "sim-1__right"} <= set(console.peers_by_id))
    for name in ("left", "right"):
        console.send(f"sim-1__{name}", START, timeout=20)

    def told() -> dict[str, bool]:
        answers = console.broadcast({"action": "stop", "robot_name": "right"}, 0.5)
        return {each["responder_id"]: each["result"]["ok"] for each in answers}

    # Those that a busy machine lets answer later are asked again.
    eventually(lambda: told() == {"sim-1": True, "sim-1__left": False, "sim-1__right": True})
    eventually(lambda: [row["robot"] for row in world.list_policies_running()] == ["left"])
    steps = world.rollouts["left"].steps
    eventually(lambda: world.rollouts["left"].steps > steps + 5)
    world.close()


@pytest.mark.parametrize("action", ["step", "reset", "teleop_status"])
def test_what_concerns_the_world_is_refused_by_its_robots(peers: Fleet, action: str) -> None:
    world, _, console = joined(peers)
    assert console.send("sim-1__left", {"action": action}, timeout=20)["result"]["status"] == "error"
    assert world.steps == 0


def test_an_emergency_stop_finds_no_child_silent_and_locks_them(peers: Fleet) -> None:
    world, mesh, console = joined(peers)
    console.send("sim-1__left", START, timeout=20)
    answers = console.emergency_stop()
    assert {answer["responder_id"] for answer in answers} == {"sim-1", "sim-1__left", "sim-1__right"}
    recorded = peers.events("emergency_stop")[0]
    assert (recorded["not_stopped"], recorded["silent"]) == ([], [])
    assert world.running == {}
    eventually(lambda: mesh.lockout_epoch is not None)
    assert console.send("sim-1__left", START, timeout=20)["error"] == "command rejected"


def test_robots_come_and_go_with_their_world(peers: Fleet) -> None:
    world, mesh, console = joined(peers)
    world.names.remove("right")
    children = mesh.children
    assert children is not None
    eventually(lambda: not children.peers)
    eventually(lambda: not console.peers_by_id["sim-1__left"]["reachable"])
    world.names.append("middle")
    eventually(lambda: "sim-1__middle" in console.peers_by_id)
    mesh.stop()
    assert console.send("sim-1__middle", {"action": "ping"}, timeout=0.1)["status"] == "timeout"


class Wedged(World):
    """A world whose list of policies hangs while it is held."""

    def __init__(self, *names: str) -> None:
        super().__init__(*names)
        self.hangs, self.free = threading.Event(), threading.Event()
        self.free.set()

    def list_policies_running(self) -> list[dict[str, Any]]:
        if not self.free.is_set():
            self.hangs.set()
            self.free.wait(60)
        return super().list_policies_running()


def declared_keys(peers: Fleet) -> list[str]:
    """The keys that the robots of ``sim-1`` have declared."""
    return [each.key for each in peers.bus.declared_by(peers.transports["sim-1"]) if "sim-1__" in each.key]


def test_robots_whose_world_hangs_in_its_read_take_commands_and_are_announced_by_name_alone(peers: Fleet) -> None:
    world = Wedged("left")
    mesh, console = peers.join(world, "sim-1", "sim"), peers.join(None, "console")
    children = mesh.children
    assert children is not None
    world.free.clear()
    # The sampler hangs as well, so that nobody but this test asks for the children.
    assert world.hangs.wait(20)
    world.names.append("right")
    reading = threading.Thread(target=children.refresh)
    reading.start()
    try:
        eventually(lambda: children.peers == {"sim-1__left", "sim-1__right"})
        children.announce()
        assert set(console.peers_by_id) == {"sim-1"}, "neither has been described yet"
        peers.clock.pass_(DESCRIBE_S)
        children.announce()
        assert "tool_name" not in console.peers_by_id["sim-1__right"]
        assert console.ping("sim-1__right", timeout=20)["status"] == "ok"
        children.close()
        assert declared_keys(peers) == []
    finally:
        world.free.set()
        reading.join(20)
    assert children.peers == set()


def test_a_robot_that_begins_while_its_world_leaves_is_taken_away(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World("left")
    children = peers.join(world, "sim-1", "sim").children
    assert children is not None
    transport, declared = peers.transports["sim-1"], list[str]()
    declare = transport.declare_token

    def while_leaving(key: str) -> Any:
        children.close()
        token = declare(key)
        declared.append(key)
        return token

    monkeypatch.setattr(transport, "declare_token", while_leaving)
    world.names.append("right")
    eventually(lambda: declared)
    eventually(lambda: not declared_keys(peers))
    assert len(declared) == 1


def test_who_hears_a_robot_may_leave_the_mesh_on_the_thread_that_announces_it(peers: Fleet) -> None:
    _, mesh, _ = joined(peers)
    left = threading.Event()

    def leave(_: object) -> None:
        mesh.stop()
        left.set()

    peers.stranger().declare_subscriber("strands/sim-1__left/presence", leave)
    eventually(left.is_set)
    assert declared_keys(peers) == []


def test_a_broker_that_pins_a_peer_to_its_topics_is_shown_no_children(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MemoryTransport, "pins_topics", True)
    mesh, console = peers.join(World("left", "right"), "sim-1", "sim"), peers.join(None, "console")
    assert mesh.children is not None
    mesh.children.refresh()
    mesh.children.announce()
    assert set(console.peers_by_id) == {"sim-1"}


def test_a_world_of_one_robot_is_one_peer(peers: Fleet) -> None:
    mesh, console = peers.join(World("left"), "sim-1", "sim"), peers.join(None, "console")
    assert mesh.children is not None
    mesh.children.refresh()
    assert set(console.peers_by_id) == {"sim-1"}


def test_each_arm_of_a_world_moves_by_its_own_name(peers: Fleet) -> None:
    world = Simulation()
    for name in ("left", "right"):
        assert world.add_robot(name, "so100")["status"] == "success"
    peers.join(world, "sim-1", "sim")
    console = peers.join(None, "console")
    eventually(lambda: {"sim-1__left", "sim-1__right"} <= set(console.peers_by_id))
    still = world.body("left").targets
    move = {"action": "moveJoints", "joints": {"shoulder_pan": 10.0}, "speed": 1.0, "picture": "right/wrist"}
    moved = console.send("sim-1__right", move, timeout=30)["result"]
    assert moved["task_status"] == "completed", moved
    assert moved["picture"]["camera"] == "right/wrist"
    assert world.body("left").targets == still
    other = console.send("sim-1__right", {**move, "robot_name": "left"}, timeout=30)["result"]
    assert "robot_name must be right" in other["reason"]
    status = console.send("sim-1__right", {"action": "status"}, timeout=20)["result"]
    assert status["outcomes"]["right"]["task_id"] == moved["task_id"]
    assert console.send("sim-1__left", {"action": "status"}, timeout=20)["result"]["outcomes"] == {}
    world.cleanup()
