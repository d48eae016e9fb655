"""An agent and a teleoperator at one robot: one moves it, the other is refused by name."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh import input_receiver
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.input import InputPublisher
from strands_robots.mesh.input_receiver import HOLD_S, LOST_S
from strands_robots.serving.control_leases import leases_of
from strands_robots.simulation import Simulation


class Leader:
    """A teleoperator whose shoulder goes to and fro."""

    def __init__(self) -> None:
        self.reads = 0

    def get_action(self) -> dict[str, float]:
        self.reads += 1
        return {"shoulder_pan": (self.reads % 20) / 100}


class Cell:
    """A simulated arm, an agent, and a leader with its publisher."""

    def __init__(self, peers: Fleet) -> None:
        self.world = Simulation()
        assert self.world.add_robot("arm", "so100")["status"] == "success"
        self.robot = peers.join(self.world, "sim-1", "sim")
        self.agent, self.lead = peers.join(None, "agent"), peers.join(None, "lead")
        self.publisher = InputPublisher(self.lead, Leader(), hz=50)

    def ask(self, peer: Mesh, action: str, **arguments: Any) -> dict[str, Any]:
        reply = peer.send("sim-1", {"action": action, **arguments}, timeout=20)
        return reply.get("result") or reply

    def follow(self) -> dict[str, Any]:
        return self.ask(self.lead, "teleop_receive", source_peer_id="lead")

    def stream(self) -> dict[str, Any]:
        [row] = self.ask(self.agent, "teleop_status")["streams"]
        return dict(row)

    def begin(self) -> None:
        assert self.follow()["status"] == "success"
        self.publisher.start()
        eventually(lambda: self.stream()["frames_received"] > 10, what="frames")

    def close(self) -> None:
        self.publisher.stop()
        self.world.cleanup()


def real_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a leader be silent after half a second and lost after two, as in the field."""
    monkeypatch.setattr(input_receiver, "HOLD_S", HOLD_S)
    monkeypatch.setattr(input_receiver, "LOST_S", LOST_S)


@pytest.fixture
def cell(peers: Fleet) -> Iterator[Cell]:
    made = Cell(peers)
    yield made
    made.close()


def test_teleoperator_is_refused_while_an_agent_holds_the_robot(cell: Cell) -> None:
    held = cell.ask(cell.agent, "acquireControl")
    assert cell.ask(cell.lead, "status")["control"]["holder"] == "agent"
    refused = cell.follow()
    assert "agent (agent) holds control" in str(refused)
    assert cell.ask(cell.agent, "releaseControl", lease_id=held["lease_id"])["status"] == "success"
    cell.begin()


def test_agent_is_refused_while_a_teleoperator_leads_and_free_after_it_fell_silent(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell.begin()
    assert "lead (human) holds control" in str(cell.ask(cell.agent, "moveJoints", joints={"shoulder_pan": 5.0}))
    assert "lead (human) holds control" in str(cell.ask(cell.agent, "acquireControl"))
    # As a leader that crashed: no frame follows, and nobody closes the stream.
    cell.publisher.stop()
    real_windows(monkeypatch)
    acquired = {"action": "acquireControl", "ttl_s": 0.5}
    eventually(lambda: cell.ask(cell.agent, **acquired).get("status") == "success", what="a free robot")
    assert cell.ask(cell.agent, "status")["status"] == "success"
    assert cell.robot.lockout_epoch is None


class Watch:
    """The time module of the receiver, which a test stops, and counts the looks at."""

    def __init__(self) -> None:
        self.at: float | None = None
        self.looks = 0

    def monotonic(self) -> float:
        self.looks += 1
        return time.monotonic() if self.at is None else self.at

    def stop(self) -> float:
        self.at = time.monotonic()
        return self.at

    def go_to(self, at: float) -> None:
        """Set the time, and return once the receiver has looked at it often."""
        self.at, before = at, self.looks
        eventually(lambda: self.looks > before + 10, what="looks at the time")


def test_follower_of_a_silent_leader_holds_after_half_a_second_and_follows_on_after_any_pause(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch()
    monkeypatch.setattr(input_receiver, "time", watch)
    monkeypatch.setenv("STRANDS_MESH_INPUT_MAX_HZ", "0")
    cell.begin()
    last, before = watch.stop(), cell.stream()["frames_received"]
    real_windows(monkeypatch)
    eventually(lambda: cell.stream()["frames_received"] > before + 1, what="frames at the time that stands still")
    sent = cell.publisher.stop()["frames"]

    def taken() -> int:
        row = cell.stream()
        return int(row["frames_received"] + row["rate_dropped"])

    eventually(lambda: taken() >= sent, what="the last frame")
    watch.go_to(last + HOLD_S - 0.01)
    assert not cell.stream()["holding"]
    watch.go_to(last + HOLD_S + 0.01)
    eventually(lambda: cell.stream()["holding"], what="the hold")
    watch.go_to(last + 60 * LOST_S)
    assert cell.stream()["running"]
    assert cell.ask(cell.agent, "getControl")["holder"] == "lead"
    targets = cell.world.body("arm").targets
    where = cell.world.body("arm").get_joints()
    assert targets["shoulder_pan"] == pytest.approx(where["shoulder_pan"], abs=0.05)
    before = cell.stream()["frames_received"]
    again = InputPublisher(cell.lead, Leader(), hz=50)
    again.start()
    try:
        eventually(lambda: cell.stream()["frames_received"] > before, what="frames again")
        assert not cell.stream()["holding"]
    finally:
        again.stop()
    assert cell.world.gate.refusal("motion") is None


def test_stream_in_a_pause_ends_with_its_lifetime(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.begin()
    cell.publisher.stop()
    monkeypatch.setenv("STRANDS_MESH_INPUT_STREAM_TTL_S", "1")
    eventually(lambda: not cell.stream()["running"], what="the end of the stream")


def test_stream_of_a_leader_that_left_the_mesh_ends_and_says_so(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.begin()
    cell.publisher.stop()
    monkeypatch.setattr(input_receiver, "LOST_S", LOST_S)
    cell.lead.stop()
    eventually(lambda: not cell.stream()["running"], what="the end of the stream")
    assert "left the mesh" in cell.stream()["ended"]
    assert cell.ask(cell.agent, "acquireControl")["status"] == "success"


def test_caller_that_moves_the_robot_in_a_pause_ends_the_stream(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.begin()
    cell.publisher.stop()
    real_windows(monkeypatch)

    acquired = {"action": "acquireControl", "ttl_s": 60.0}
    eventually(lambda: cell.ask(cell.agent, **acquired).get("status") == "success", what="a robot free for the agent")
    again = InputPublisher(cell.lead, Leader(), hz=50)
    again.start()
    try:
        eventually(lambda: not cell.ask(cell.agent, "teleop_status")["streams"], what="no stream")
    finally:
        again.stop()
    assert cell.world.gate.refusal("motion") is None


def test_leader_that_pauses_leads_on(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.begin()
    cell.publisher.stop()
    monkeypatch.setattr(input_receiver, "HOLD_S", HOLD_S)
    eventually(lambda: cell.stream()["holding"], what="the hold")
    again = InputPublisher(cell.lead, Leader(), hz=50)
    again.start()
    eventually(lambda: not cell.stream()["holding"], what="frames again")
    assert cell.stream()["running"]
    again.stop()


def test_takeover_ends_the_stream_of_the_teleoperator_before_its_answer(cell: Cell) -> None:
    cell.begin()
    taken = cell.ask(cell.agent, "takeControl", reason="a hand in the way")
    received = cell.stream()["frames_received"]
    assert taken["status"] == "success"
    assert not cell.stream()["running"]
    targets = cell.world.body("arm").targets
    time.sleep(0.2)  # ten frames of the leader, none of which may count
    assert cell.stream()["frames_received"] == received
    assert cell.ask(cell.agent, "releaseControl", lease_id=taken["lease_id"])["status"] == "success"
    assert cell.world.body("arm").targets == targets


def test_agent_gets_no_lease_of_a_robot_that_is_led_at_its_own_machine(cell: Cell) -> None:
    assert cell.world.attach_teleop(Leader(), "joystick")["status"] == "success"
    assert cell.world.teleoperate("joystick")["status"] == "success"
    refused = cell.ask(cell.agent, "acquireControl")
    assert "joystick (human) leads it" in str(refused)
    assert cell.world.stop_teleoperate()["stopped"] is True
    assert cell.ask(cell.agent, "acquireControl", ttl_s=0.5)["status"] == "success"
    assert leases_of(cell.world, hardware=False).of().facts()["holder"] == "agent"


def without_threads(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """Let the system have no thread whose name begins with ``kind``."""
    start = threading.Thread.start

    def scarce(thread: threading.Thread) -> None:
        if thread.name.startswith(kind):
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", scarce)


def test_follower_of_a_silent_leader_holds_and_is_let_go_without_a_thread_for_the_hold(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[str] = []
    monkeypatch.setattr(input_receiver.InputReceiver, "_hold", lambda self: held.append(self.topic))
    without_threads(monkeypatch, "mesh-hold")
    cell.begin()
    cell.publisher.stop()
    real_windows(monkeypatch)
    eventually(lambda: not cell.stream()["running"], within=20.0, what="the end of the stream")
    eventually(lambda: len(held) == 1, within=20.0, what="the hold on the watching thread")


def test_stream_that_nothing_would_watch_is_refused(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    without_threads(monkeypatch, "mesh-watch")
    answer = cell.follow()
    assert answer["status"] == "error" and "can't start new thread" in str(answer), answer


def test_no_second_hold_begins_while_one_waits_for_the_bus(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    bus, holds = threading.Event(), []
    receivers: set[input_receiver.InputReceiver] = set()

    def hold(receiver: input_receiver.InputReceiver) -> None:
        receivers.add(receiver)
        holds.append(receiver.topic)
        assert bus.wait(60.0)

    monkeypatch.setattr(input_receiver.InputReceiver, "_hold", hold)
    cell.begin()
    cell.publisher.stop()
    monkeypatch.setattr(input_receiver, "HOLD_S", HOLD_S)
    eventually(lambda: len(holds) == 1, within=20.0, what="the first hold")
    [receiver] = receivers
    watch = Watch()
    monkeypatch.setattr(input_receiver, "time", watch)
    watch.stop()
    receiver._holds = False  # as a frame that came meanwhile leaves it
    watch.go_to(receiver._moved + 2 * HOLD_S)
    assert len(holds) == 1
    bus.set()
    eventually(lambda: len(holds) == 2, within=20.0, what="the hold after it")
