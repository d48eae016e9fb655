"""Teleoperation of a real robot through the loop, gate and write path of tasks."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.teleoperators import LeaderPolicy

WAVES = {"pan.pos": (20.0, 50.0, 1.0), "lift.pos": (20.0, 50.0, 1.0)}


class Leader:
    """Returns ``action``, or calls it."""

    def __init__(self, action: Any) -> None:
        self.action = action

    def get_action(self) -> Any:
        return self.action() if callable(self.action) else self.action


class Sink:
    def __init__(self, broken: bool = False) -> None:
        self.frames: list[tuple[str, str, dict[str, float], Any]] = []
        self._broken = broken

    def publish(self, device: str, method: str, action: Mapping[str, float], events: Any) -> None:
        if self._broken:
            raise ConnectionError("no network")
        self.frames.append((device, method, dict(action), events))


@pytest.fixture
def robot() -> Iterator[HardwareRobot]:
    made = HardwareRobot(RecordingDevice(), "arm", control_hz=200)
    made.connect()
    yield made
    made.cleanup()


def test_leader_drives_the_follower_until_stopped(robot: HardwareRobot) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    assert robot.teleoperate(hz=200)["status"] == "success"
    eventually(lambda: len(robot.device.writes) > 20)
    status = robot.teleop_status()
    assert status["running"] == ["leader"]
    assert status["leaders"]["leader"]["frames"] > 10
    answer = robot.stop_teleoperate()
    moment = time.monotonic()
    assert answer["stopped"] is True
    assert not robot.device.written_after(moment)
    assert robot.teleop_status()["running"] == []
    assert robot.stop_teleoperate()["was_running"] is False


def test_halt_stops_a_leader(robot: HardwareRobot) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    robot.teleoperate()
    eventually(lambda: robot.device.writes)
    verdict = robot.halt()
    moment = time.monotonic()
    assert (verdict.stopped, verdict.halted) == (True, ("teleoperation leader",))
    assert not robot.device.written_after(moment)


def test_one_source_drives_at_a_time(robot: HardwareRobot) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    robot.teleoperate()
    assert "leader" in robot.start_task("wave")["reason"]
    assert "leader" in robot.send_action({"pan.pos": 0.0})["reason"]
    assert "driven by leader" in robot.teleoperate()["reason"]
    robot.stop_teleoperate()
    robot.start_task("wave")
    assert "the task 'wave'" in robot.teleoperate()["reason"]


def test_follower_moves_to_a_distant_leader_at_the_speed_bound(robot: HardwareRobot) -> None:
    robot.attach_teleop(Leader({"pan.pos": 100.0}), max_speed=1.0)
    robot.teleoperate(hz=100)
    eventually(lambda: robot.device.positions["pan.pos"] == 100.0)
    robot.stop_teleoperate()
    targets = [10.0, *(write.action["pan.pos"] for write in robot.device.writes if len(write.action) == 1)]
    assert max(b - a for a, b in itertools.pairwise(targets)) <= 200 * 2 / 100 + 1e-6


def test_keys_of_a_leader_are_renamed(robot: HardwareRobot) -> None:
    robot.attach_teleop(Leader({"shoulder": 12.0}), keys={"shoulder": "pan.pos"})
    robot.teleoperate()
    eventually(lambda: robot.device.positions["pan.pos"] == 12.0)


@pytest.mark.parametrize("bad", [{"pan.pos": float("nan")}, {"elbow": 1.0}, None, [], {"pan.pos": True}], ids=repr)
def test_leader_without_usable_frames_ends_in_an_error_and_the_follower_stops(robot: HardwareRobot, bad: Any) -> None:
    robot.attach_teleop(Leader(bad))
    robot.teleoperate()
    eventually(lambda: robot.teleop_status()["leaders"]["leader"]["state"] == "error")
    row = robot.teleop_status()["leaders"]["leader"]
    assert row["errors"] > 5
    assert row["error"]
    assert [write.action for write in robot.device.writes] == [dict.fromkeys(robot.device.positions, 10.0)]


def test_occasional_bad_frame_is_counted_and_not_applied(robot: HardwareRobot) -> None:
    count = iter(range(10**9))

    def sometimes() -> dict[str, float]:
        if next(count) % 3 == 0:
            raise ConnectionError("no status packet")
        return {"pan.pos": 15.0}

    robot.attach_teleop(Leader(sometimes))
    robot.teleoperate(hz=200)
    eventually(lambda: robot.teleop_status()["leaders"]["leader"]["frames"] > 20)
    assert robot.teleop_status()["leaders"]["leader"]["errors"] >= 7
    assert robot.teleop_status()["running"] == ["leader"]


@pytest.fixture
def hanging() -> Iterator[tuple[Leader, threading.Event]]:
    """A leader whose read hangs, and the event of its first read; it returns a target at the end of the test."""
    free, hangs = threading.Event(), threading.Event()

    def hang() -> dict[str, float]:
        hangs.set()
        free.wait(60)
        return {"pan.pos": 99.0}

    yield Leader(hang), hangs
    free.set()


Stop = Callable[[HardwareRobot], bool | None]


@pytest.mark.parametrize(
    "stop",
    [
        lambda robot: robot.stop_teleoperate(timeout=20)["stopped"],
        lambda robot: robot.halt("stop").stopped,
        lambda robot: stop_executor().submit(robot, "arm", "stop").result(20).stopped,
    ],
    ids=["stop_teleoperate", "halt", "executor"],
)
def test_stop_waits_for_no_leader_whose_read_hangs(
    robot: HardwareRobot, hanging: tuple[Leader, threading.Event], stop: Stop
) -> None:
    leader, hangs = hanging
    robot.attach_teleop(leader)
    robot.teleoperate()
    assert hangs.wait(20)
    assert stop(robot) is True
    assert not robot.teleop_status()["running"]
    assert all(write.action["pan.pos"] != 99.0 for write in robot.device.writes)


def test_leader_whose_read_hangs_ends_its_teleoperation_and_the_follower_stops(
    robot: HardwareRobot, hanging: tuple[Leader, threading.Event]
) -> None:
    robot.attach_teleop(hanging[0])
    robot.teleoperate()
    eventually(lambda: not robot.teleop_status()["running"])
    row = robot.teleop_status()["leaders"]["leader"]
    assert (row["state"], "leader has not answered for 0.5 s" in row["error"]) == ("error", True)
    assert [write.action for write in robot.device.writes] == [dict.fromkeys(robot.device.positions, 10.0)]


def test_frames_go_to_the_network_on_publish(robot: HardwareRobot) -> None:
    robot.attach_teleop(Leader({"pan.pos": 12.0}), name="left", method="gamepad")
    assert "publish" in robot.teleoperate("left", publish=True)["reason"]
    sink = robot.input_sink = Sink()
    robot.teleoperate("left", publish=True)
    eventually(lambda: sink.frames)
    robot.stop_teleoperate()
    assert sink.frames[0] == ("left", "gamepad", {"pan.pos": 12.0}, None)


def test_failing_network_does_not_disturb_the_follower(robot: HardwareRobot) -> None:
    robot.input_sink = Sink(broken=True)
    robot.attach_teleop(Leader({"pan.pos": 12.0}))
    robot.teleoperate(publish=True)
    eventually(lambda: len(robot.device.writes) > 5)
    assert robot.teleop_status()["running"] == ["leader"]


def test_unusable_leader_and_bad_options_are_refused(robot: HardwareRobot) -> None:
    assert "get_action" in robot.attach_teleop(object())["reason"]
    leader = ScriptedLeader(WAVES)
    for bad in ({"name": "a/b"}, {"method": "mind"}, {"max_speed": 0}, {"robot_name": "other"}):
        assert robot.attach_teleop(leader, **bad)["status"] == "error"  # type: ignore[arg-type]
    assert "attach_teleop it first" in robot.teleoperate("nobody")["reason"]
    robot.attach_teleop(leader)
    for bad in ({"hz": 0}, {"hz": float("nan")}, {"duration": -1}, {"publish": 1}):
        assert robot.teleoperate(**bad)["status"] == "error"  # type: ignore[arg-type]
    leader.is_connected = False
    robot.teleoperate()
    eventually(lambda: "not connected" in robot.teleop_status()["leaders"]["leader"]["error"])


def test_events_of_a_leader_are_published_with_its_frames() -> None:
    class Pad(Leader):
        def get_teleop_events(self) -> dict[str, bool]:
            return {"terminate_episode": True}

    sink = Sink()
    policy = LeaderPolicy(Pad({"a": 0.0}), sink=sink)
    policy.reset("", {"a": (-1.0, 1.0)})
    policy.act({"a": 0.0})
    assert sink.frames[0][3] == {"terminate_episode": True}


def test_unreadable_events_are_counted_and_logged_once(robot: HardwareRobot, caplog: pytest.LogCaptureFixture) -> None:
    class Mute(Leader):
        def get_teleop_events(self) -> dict[str, bool]:
            raise OSError("no events")

    sink = Sink()
    robot.input_sink = sink
    robot.attach_teleop(Mute({"pan.pos": 10.0}))
    robot.teleoperate(publish=True)
    eventually(lambda: len(sink.frames) >= 3)
    robot.stop_teleoperate()
    row = robot.teleop_status()["leaders"]["leader"]
    assert row["event_read_errors"] == row["frames"] == len(sink.frames)
    assert row["errors"] == 0
    assert {frame[3] for frame in sink.frames} == {None}
    assert sum("cannot be read" in line.getMessage() for line in caplog.records) == 1
