"""Leader to follower: what is published, and every guard that a frame passes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from enum import Enum
from typing import Any

import numpy as np
import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, signed

from strands_robots.envelope import success
from strands_robots.hardware import HardwareRobot
from strands_robots.mesh import input as input_module
from strands_robots.mesh import input_receiver, safety
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.input import InputPublisher, InputReceiver, MeshInputSink
from strands_robots.mesh.security import ValidationError


class Leader:
    """A teleoperator that counts upwards."""

    def __init__(self) -> None:
        self.reads = 0

    def get_action(self) -> dict[str, float]:
        self.reads += 1
        return {"shoulder.pos": self.reads / 10}


class Stream:
    """A follower, its receiver and the leader's own session to send frames by hand."""

    def __init__(self, peers: Fleet) -> None:
        self.peers, self.arm = peers, Arm()
        self.follower: Mesh = peers.join(self.arm, "follower")
        self.leader = peers.stranger()
        self.leader.put("strands/lead/presence", {"robot_id": "lead", "timestamp": peers.clock()})
        self.receiver = InputReceiver(self.follower, self.arm, "lead")
        self.sequence = 0

    def frame(self, **fields: Any) -> dict[str, Any]:
        self.sequence += 1
        body = {"peer_id": "lead", "device": "leader", "method": "arm", "t": self.peers.clock(), "seq": self.sequence}
        frame = {**body, "action": {"shoulder.pos": 1.0}, "events": None, **fields}
        return signed(self.peers, frame)

    def send(self, **fields: Any) -> None:
        time.sleep(0.011)  # the cap is 100 a second
        self.leader.put("strands/lead/input/leader", self.frame(**fields))

    def stat(self, name: str) -> Callable[[], int]:
        return lambda: int(self.receiver.stats[name])


@pytest.fixture
def stream(peers: Fleet) -> Iterator[Stream]:
    made = Stream(peers)
    made.receiver.start()
    assert made.receiver.start_refusal is None
    yield made
    made.receiver.stop()


def first_frame(peers: Fleet, teleoperator: Any) -> dict[str, Any]:
    """The first frame that a leader's publisher puts on the mesh."""
    frames: list[Any] = []
    listener, lead = peers.join(None, "listener"), peers.join(None, "lead")
    publisher = InputPublisher(lead, teleoperator, hz=50)
    assert listener.subscribe(publisher.topic, lambda key, data: frames.append(data))
    publisher.start()
    eventually(lambda: frames)
    publisher.stop()
    frame: dict[str, Any] = frames[0]
    return frame


def test_a_leaders_actions_reach_the_follower_in_order(peers: Fleet) -> None:
    arm = Arm()
    follower, lead = peers.join(arm, "follower"), peers.join(None, "lead")
    receiver = InputReceiver(follower, arm, "lead")
    publisher = InputPublisher(lead, Leader(), hz=50)
    receiver.start()
    publisher.start()
    eventually(lambda: len(arm.actions) >= 10)
    sent, got = publisher.stop(), receiver.stop()
    values = [action["shoulder.pos"] for action in arm.actions]
    assert values == sorted(values)
    assert sent["running"] is sent["thread_alive"] is False
    assert got["frames_received"] == len(arm.actions)
    assert got["rejected"] == got["errors"] == 0
    assert peers.events("input_stream_opened")


def test_restarted_leader_is_still_followed(peers: Fleet) -> None:
    arm = Arm()
    follower, lead = peers.join(arm, "follower"), peers.join(None, "lead")
    receiver = InputReceiver(follower, arm, "lead")
    receiver.start()
    for _ in range(2):
        arm.actions.clear()
        publisher = InputPublisher(lead, Leader(), hz=50)
        publisher.start()
        eventually(lambda: len(arm.actions) >= 5)
        publisher.stop()
    assert receiver.stop()["out_of_order"] == 0


def test_a_stream_needs_a_leader_that_was_seen(peers: Fleet) -> None:
    arm = Arm()
    receiver = InputReceiver(peers.join(arm, "follower"), arm, "absent")
    receiver.start()
    assert receiver.start_refusal is not None
    assert peers.events("input_stream_refused")


def test_a_stream_whose_leader_is_lost_is_closed_while_the_followers_bus_hangs(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    holding, free = threading.Event(), threading.Event()

    class Hanging:
        def hold(self, permit: object) -> None:
            holding.set()
            free.wait(60)

    monkeypatch.setattr(stream.arm, "body", Hanging, raising=False)
    monkeypatch.setattr(input_receiver, "HOLD_S", 0.05)
    stream.send()
    try:
        assert holding.wait(20)
        monkeypatch.setattr(input_receiver, "LOST_S", 0.1)
        assert stream.receiver.running
        monkeypatch.setattr(Mesh, "left", lambda *_: True)
        eventually(lambda: not stream.receiver.running)
        assert not free.is_set()
    finally:
        free.set()
    assert stream.peers.events("input_stream_lost")


def test_a_locked_follower_opens_no_stream_and_an_open_one_ends(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream.send()
    eventually(lambda: stream.arm.actions)
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)  # the leader here answers nothing
    stream.follower.emergency_stop()
    stream.send()
    eventually(lambda: stream.stat("rejected_lockout")() == 1)
    assert len(stream.arm.actions) == 1
    assert stream.receiver.stats["running"] is False
    stream.receiver.start()
    assert stream.receiver.start_refusal is not None


def test_a_halt_ends_a_stream_without_locking(stream: Stream) -> None:
    stream.arm.halt("by hand")
    assert stream.receiver.stats["running"] is False
    stream.send()
    eventually(lambda: stream.stat("rejected_lockout")() == 1)
    assert stream.arm.actions == []


def test_a_stream_that_a_halt_ended_opens_again_when_asked(stream: Stream) -> None:
    stream.arm.halt("by hand")
    stream.receiver.start()
    assert stream.receiver.running
    stream.send()
    eventually(lambda: stream.arm.actions)


def test_a_stream_that_was_asked_for_before_a_halt_does_not_open(stream: Stream) -> None:
    request = stream.arm.gate.request()
    stream.arm.halt("by hand")
    stream.receiver.start(request)
    assert "halted after it was asked for" in str(stream.receiver.start_refusal)


def test_another_session_on_the_leaders_topic_moves_nothing(stream: Stream) -> None:
    stream.peers.stranger().put("strands/lead/input/leader", stream.frame())
    eventually(lambda: stream.stat("rejected_source")() == 1)
    assert stream.arm.actions == []


@pytest.mark.parametrize("stamp", [-61.0, 6.0, None, "now", True])
def test_a_frame_that_is_not_fresh_is_refused(stream: Stream, stamp: object) -> None:
    stream.send(t=stream.peers.clock() + stamp if isinstance(stamp, float) else stamp)
    eventually(lambda: stream.stat("rejected_freshness")() == 1)


@pytest.mark.parametrize(
    "action",
    [
        {"j": float("1e5")},
        {"j": 721},
        {"j": True},
        {"j": "1"},
        {"j": [1]},
        {"x" * 65: 1},
        {f"j{number}": 1 for number in range(65)},
        [1, 2],
    ],
)
def test_an_action_out_of_bounds_is_refused(stream: Stream, action: object) -> None:
    stream.send(action=action)
    eventually(lambda: stream.stat("rejected_invalid")() == 1)
    assert stream.receiver.stats["rejected"] == 1
    assert stream.arm.actions == []


def test_a_null_action_an_old_frame_and_a_burst_move_nothing(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    stream.send(action=None)
    stream.send(seq=10)
    stream.send(seq=10)
    eventually(lambda: stream.stat("out_of_order")() == 1)
    # One a second: however long it takes to send them, few of a hundred are let through.
    monkeypatch.setenv("STRANDS_MESH_INPUT_MAX_HZ", "1")
    for number in range(11, 111):
        stream.leader.put("strands/lead/input/leader", stream.frame(seq=number))
    eventually(lambda: stream.stat("rate_dropped")() >= 70)
    assert len(stream.arm.actions) <= 25


def test_frames_delayed_by_a_slow_bus_do_not_count_as_a_flood(stream: Stream) -> None:
    free = threading.Event()
    taken: list[dict[str, float]] = []

    def slow(body: Any, action: dict[str, float]) -> None:
        free.wait(20)
        taken.append(action)

    receiver = InputReceiver(stream.follower, stream.arm, "lead", apply_fn=slow)
    stream.receiver.stop()
    receiver.start()
    for _ in range(25):
        stream.send()
    free.set()
    eventually(lambda: len(taken) == 25)
    assert receiver.stop()["rate_dropped"] == 0


def test_a_joint_commanded_too_fast_is_refused(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    # Ten a second: no machine is so slow that 300 are not too fast.
    monkeypatch.setenv("STRANDS_MESH_INPUT_SLEW_ABS", "10")
    stream.send(action={"shoulder.pos": 0.0})
    stream.send(action={"shoulder.pos": 300.0})
    eventually(lambda: stream.stat("slew_rejected")() == 1)
    stream.send(action={"shoulder.pos": 0.05})
    eventually(lambda: stream.stat("frames_received")() == 2)


def test_first_frame_is_bounded_by_the_followers_position(stream: Stream) -> None:
    where = success("state", joints={"shoulder.pos": 10.0}, task={})
    stream.arm.get_state = lambda: where  # type: ignore[method-assign]
    stream.send(action={"shoulder.pos": 700.0})
    eventually(lambda: stream.stat("slew_rejected")() == 1)
    stream.send(action={"shoulder.pos": 11.0})
    eventually(lambda: stream.stat("frames_received")() == 1)
    assert stream.arm.actions == [{"shoulder.pos": 11.0}]


def test_first_frame_after_a_pause_is_bounded_by_the_followers_position(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = {"shoulder.pos": 10.0}
    stream.arm.get_state = lambda: success("state", joints=dict(at), task={})  # type: ignore[method-assign]
    stream.send(action={"shoulder.pos": 11.0})
    eventually(lambda: stream.stat("frames_received")() == 1)
    monkeypatch.setattr(input_receiver, "HOLD_S", 0.05)
    eventually(lambda: stream.receiver.stats["holding"], what="the hold")
    # By the time since its last frame, a leader could have gone anywhere.
    stream.receiver._last = {"shoulder.pos": (11.0, time.monotonic() - 3600.0)}
    at["shoulder.pos"] = 12.0
    stream.send(action={"shoulder.pos": 700.0})
    eventually(lambda: stream.stat("slew_rejected")() == 1)
    assert len(stream.arm.actions) == 1
    monkeypatch.setattr(input_receiver, "HOLD_S", 600.0)
    stream.send(action={"shoulder.pos": 12.5})
    eventually(lambda: stream.stat("frames_received")() == 2)
    assert stream.receiver.running


def test_first_frame_after_a_pause_is_bounded_by_the_last_one_where_no_joints_are_read(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream.arm.get_state = lambda: success("state", joints={}, task={})  # type: ignore[method-assign]
    stream.send(action={"shoulder.pos": 11.0})
    eventually(lambda: stream.stat("frames_received")() == 1)
    monkeypatch.setattr(input_receiver, "HOLD_S", 0.05)
    eventually(lambda: stream.receiver.stats["holding"], what="the hold")
    stream.send(action={"shoulder.pos": 700.0})
    eventually(lambda: stream.stat("slew_rejected")() == 1)


def test_follower_that_may_keep_a_speed_is_halted_in_a_pause(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(input_receiver, "HOLD_S", 0.05)
    stream.send(action={"shoulder.pos": 1.0, "x.vel": 0.5})
    eventually(lambda: stream.arm.halts == ["its leader is silent"])
    assert not stream.receiver.running


def test_stranger_that_may_keep_a_speed_is_stopped_in_a_pause(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(input_receiver, "HOLD_S", 0.05)

    class Base:
        stops = 0

        def send_action(self, action: dict[str, float]) -> None: ...

        def stop_task(self) -> dict[str, Any]:
            self.stops += 1
            return {"status": "error"}

    base = Base()
    follower, leader = peers.join(base, "follower"), peers.stranger()
    leader.put("strands/lead/presence", {"robot_id": "lead", "timestamp": peers.clock()})
    receiver = InputReceiver(follower, base, "lead")
    receiver.start()
    frame = {"peer_id": "lead", "device": "leader", "method": "arm", "t": peers.clock(), "seq": 1, "events": None}
    leader.put("strands/lead/input/leader", signed(peers, {**frame, "action": {"x.vel": 0.5}}))
    try:
        assert eventually(lambda: base.stops)
        assert eventually(lambda: not receiver.running)
        assert eventually(lambda: "in its leader's pause the follower did not stop" in caplog.text)
    finally:
        receiver.stop()


def test_no_frame_is_applied_while_the_followers_joints_cannot_be_read(stream: Stream) -> None:
    report = {"joints": {"shoulder.pos": 90.0}, "joints_error": "The bus was busy for 1 s."}
    stream.arm.get_state = lambda: success("state", **report)  # type: ignore[method-assign]
    for _ in range(2):
        stream.send(action={"shoulder.pos": 90.0})
    eventually(lambda: stream.stat("slew_rejected")() == 2)
    report.update(joints={"shoulder.pos": 10.0}, joints_error="")
    stream.send(action={"shoulder.pos": 90.0})
    eventually(lambda: stream.stat("slew_rejected")() == 3)
    stream.send(action={"shoulder.pos": 11.0})
    eventually(lambda: stream.arm.actions == [{"shoulder.pos": 11.0}])


def test_follower_without_readable_joints_is_still_led(stream: Stream) -> None:
    def unread() -> Any:
        raise ConnectionError("no status packet")

    stream.arm.get_state = unread  # type: ignore[method-assign]
    stream.send(action={"shoulder.pos": 90.0})
    eventually(lambda: stream.arm.actions)


def test_a_stream_ends_with_its_lifetime(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_INPUT_STREAM_TTL_S", "1")
    stream.receiver._opened -= 2
    stream.send()
    eventually(lambda: stream.peers.events("input_stream_expired"))
    assert stream.receiver.stats["rejected_expired"] == 1
    assert stream.receiver.stats["running"] is False


def test_robot_that_refuses_every_frame_counts_as_errors(stream: Stream) -> None:
    for _ in range(3):
        stream.send(action={"broken": 1.0})
    eventually(lambda: stream.stat("errors")() == 3)
    assert stream.receiver.stats["frames_received"] == 3


def test_streams_are_opened_listed_and_closed_by_command(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "teleop_receive")
    arm = Arm()
    peers.join(arm, "follower")
    lead = peers.join(None, "lead")
    receive = {"action": "teleop_receive", "source_peer_id": "lead"}
    assert lead.send("follower", receive, timeout=20)["result"]["status"] == "success"
    publisher = InputPublisher(lead, Leader(), hz=50)
    publisher.start()
    eventually(lambda: arm.actions)
    report = lead.send("follower", {"action": "teleop_status"}, timeout=20)["result"]
    assert report["streams"][0]["running"] is True
    closed = lead.send("follower", {"action": "teleop_stop"}, timeout=20)["result"]
    assert closed["streams"][0]["running"] is False
    publisher.stop()


def test_a_plain_stop_closes_the_streams_too(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "teleop_receive")
    peers.join(Arm(), "follower")
    lead = peers.join(None, "lead")
    lead.send("follower", {"action": "teleop_receive", "source_peer_id": "lead"}, timeout=20)
    assert lead.send("follower", {"action": "stop"}, timeout=20)["result"]["ok"] is True
    assert lead.send("follower", {"action": "teleop_status"}, timeout=20)["result"]["streams"] == []


@pytest.mark.parametrize("hz", [0, -1, float("nan"), float("inf"), True, "50"])
def test_a_rate_that_no_loop_can_keep_is_refused(peers: Fleet, hz: object) -> None:
    with pytest.raises(ValueError, match="hz"):
        InputPublisher(peers.join(None, "lead"), Leader(), hz=hz)  # type: ignore[arg-type]


def test_a_device_without_actions_and_a_wildcard_name_are_refused(peers: Fleet) -> None:
    mesh = peers.join(None, "lead")
    with pytest.raises(ValueError, match="get_action"):
        InputPublisher(mesh, object())
    with pytest.raises(ValidationError):
        InputPublisher(mesh, Leader(), device_name="*")
    with pytest.raises(ValidationError):
        InputReceiver(mesh, Arm(), "**")


def test_events_named_by_an_enumeration_are_published_under_their_own_names(peers: Fleet) -> None:
    class TeleopEvents(Enum):
        TERMINATE_EPISODE = "terminate_episode"

    class Pad(Leader):
        def get_teleop_events(self) -> dict[Any, Any]:
            return {TeleopEvents.TERMINATE_EPISODE: 1, "success": False}

    report = first_frame(peers, Pad())
    assert report["events"] == {"terminate_episode": True, "success": False}


def test_published_action_holds_only_floats(peers: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    class Odd(Leader):
        def get_action(self) -> dict[str, Any]:
            return {
                "whole": 3,
                "scalar": np.float32(0.5),
                "lone": np.array([[2.0]]),
                "several": np.array([1.0, 2.0]),
                "flag": np.bool_(1),
                "list": [1.0],
                "hot": float("nan"),
                "word": "x",
            }

    report = first_frame(peers, Odd())
    assert report["action"] == {"whole": 3.0, "scalar": 0.5, "lone": 2.0}
    assert all(type(value) is float for value in report["action"].values())
    assert sum("flag, hot, list, several, word" in line.getMessage() for line in caplog.records) == 1


@pytest.mark.parametrize("action", [{"a": "x"}, {"a": True}, {}, None, [1.0]])
def test_an_action_without_a_number_is_an_error_and_no_frame(peers: Fleet, action: object) -> None:
    leader = Leader()
    leader.get_action = lambda: action  # type: ignore[method-assign, assignment, return-value]
    publisher = InputPublisher(peers.join(None, "lead"), leader, hz=200)
    publisher.start()
    eventually(lambda: publisher.stats["errors"] >= 3)
    assert publisher.stop()["frames"] == 0


def test_a_publisher_whose_loop_outlived_its_stop_starts_no_second_one(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, reading = threading.Event(), threading.Event()

    class Wedged(Leader):
        def get_action(self) -> dict[str, float]:
            reading.set()
            free.wait(60)
            return super().get_action()

    publisher = InputPublisher(peers.join(None, "lead"), Wedged(), hz=200)
    publisher.start()
    assert reading.wait(20)
    with monkeypatch.context() as brief:
        brief.setattr(input_module, "_INPUT_JOIN_TIMEOUT_S", 0.05)
        assert publisher.stop()["thread_alive"] is True
    with pytest.raises(RuntimeError, match="stop it again"):
        publisher.start()
    free.set()
    assert publisher.stop()["thread_alive"] is False
    publisher.start()
    eventually(lambda: publisher.stats["frames"] >= 3)
    assert publisher.stop()["thread_alive"] is False


def test_a_device_that_fails_is_counted_and_goes_on(peers: Fleet) -> None:
    class Flaky(Leader):
        def get_action(self) -> dict[str, float]:
            if self.reads == 0:
                self.reads = 1
                raise OSError("bus")
            return super().get_action()

        def get_teleop_events(self) -> dict[str, bool]:
            raise OSError("no events")

    publisher = InputPublisher(peers.join(None, "lead"), Flaky(), hz=200)
    publisher.start()
    eventually(lambda: publisher.stats["frames"] >= 3)
    stats = publisher.stop()
    assert stats["errors"] == 1
    assert stats["event_read_errors"] >= 3


def test_frames_of_a_leader_that_is_off_the_mesh_count_as_errors(peers: Fleet) -> None:
    lead = peers.join(None, "lead")
    lead.stop()
    publisher = InputPublisher(lead, Leader(), hz=200)
    publisher.start()
    try:
        assert eventually(lambda: publisher.stats["errors"] > 1)
    finally:
        stats = publisher.stop()
    assert stats["frames"] == 0


def test_frames_of_a_local_leader_move_a_remote_follower(peers: Fleet) -> None:
    peers.clock = time.time  # type: ignore[assignment]  # these peers live in real time
    here, there = HardwareRobot(RecordingDevice()), HardwareRobot(RecordingDevice())
    here.connect()
    there.connect()
    mesh = peers.join(here, "lead")
    follower = InputReceiver(peers.join(there, "follower"), there, "lead")
    follower.start()
    assert follower.start_refusal is None
    assert here.attach_teleop(ScriptedLeader({"pan.pos": (10.0, 5.0, 0.5)}))["status"] == "success"
    assert "no network" in here.teleoperate(publish=True)["reason"]
    here.input_sink = MeshInputSink(mesh)
    assert here.teleoperate(publish=True)["status"] == "success"
    eventually(lambda: follower.stats["frames_received"] > 20)
    assert here.stop_teleoperate()["status"] == "success"
    report = follower.stop()
    assert report["errors"] == 0
    assert report["out_of_order"] == 0
    written = [write.action["pan.pos"] for write in there.device.writes]
    assert len(set(written)) > 10
    assert all(5.0 <= value <= 15.0 for value in written)
    here.cleanup()
    there.cleanup()
