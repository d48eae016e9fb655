"""The stop level ``settle``: frozen at once, then to the rest pose at bounded speed, then limp."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy
from fixtures.devices import RANGES, RecordingDevice, TorqueDevice
from fixtures.planes import own_plane
from fixtures.waiting import eventually

from strands_robots.audit import flush_audit, read_audit_log
from strands_robots.contract import RolloutEvent
from strands_robots.hardware import HardwareRobot
from strands_robots.policies import task_engine
from strands_robots.policies.settling import RANGES_PER_S, SETTLE_HZ
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.usefixtures("patient_settling")

REST = {"pan.pos": 0.0, "lift.pos": -40.0, "grip.pos": 0.0}
STEP = {key: (high - low) * RANGES_PER_S / SETTLE_HZ for key, (low, high) in RANGES.items()}
"""Longest way of one step."""


@pytest.fixture
def robot() -> Iterator[HardwareRobot]:
    made = HardwareRobot(TorqueDevice(), "settler", control_hz=200, stop_level="settle", rest_pose=REST)
    made.connect()
    yield made
    made.device.stuck = set()
    made.halt("the test is over")
    made.cleanup()


def moved(robot: HardwareRobot) -> HardwareRobot:
    """Have it move once, so that a stop has something to settle."""
    assert robot.send_action({"pan.pos": 10.0})["status"] == "success"
    return robot


def test_a_stop_freezes_then_goes_to_the_rest_pose_at_bounded_speed_and_goes_limp(robot: HardwareRobot) -> None:
    verdict = moved(robot).halt("test")
    assert (verdict.stopped, verdict.settling) == (True, True)
    assert verdict.envelope()["settling"] is True
    robot.wait_settled()
    device = robot.device
    assert device.limp == ["pan", "lift", "grip"]
    assert device.positions == REST
    frozen = device.writes[1].action
    assert frozen == {"pan.pos": 10.0, "lift.pos": 10.0, "grip.pos": 10.0}, "frozen where it was, first of all"
    writes = [write.action for write in device.writes[1:]]
    assert len(writes) >= 50 / 200 / RANGES_PER_S * SETTLE_HZ
    for before, after in itertools.pairwise(writes):
        assert all(abs(after[key] - before[key]) <= STEP[key] + 1e-9 for key in REST)


@pytest.mark.usefixtures("unending_settling")
def test_every_motion_is_refused_while_it_settles(robot: HardwareRobot) -> None:
    moved(robot).halt("test")
    answers = [robot.start_task("wave"), robot.send_action({"pan.pos": 50.0}), robot.teleoperate("leader")]
    assert robot.get_task_status()["settling"] == "settling"
    robot.halt("again")
    robot.wait_settled()
    for answer in answers[:2]:
        assert "settles to its rest pose" in answer["reason"]
    assert answers[2]["status"] == "error"
    assert robot.device.positions["pan.pos"] <= 10.0


@pytest.mark.usefixtures("unending_settling")
def test_a_second_stop_freezes_it_at_once_and_for_good(robot: HardwareRobot) -> None:
    moved(robot).halt("test")
    eventually(lambda: len(robot.device.writes) > 10)
    again = robot.halt("again")
    written = len(robot.device.writes)
    assert (again.stopped, again.settling) == (True, False)
    assert again.halted == ("settling",)
    assert "stopped again" in robot.wait_settled()
    assert robot.device.limp == []
    assert robot.device.positions != REST
    assert robot.halt("a third time").settling is False
    assert len(robot.device.writes) == written + 1, "the third freezes, and nothing else was written"


@pytest.mark.usefixtures("unending_settling")
def test_an_emergency_stop_settles_a_locked_robot_and_a_second_one_freezes_it(robot: HardwareRobot) -> None:
    with own_plane(20.0) as plane:
        plane.register("settler", moved(robot))
        report = plane.emergency_stop(StopOrder(new_epoch(), "tester"))["settler"]
        assert report.fields()["settling"] is True
        assert "locked" in robot.send_action({"pan.pos": 50.0})["reason"]
        eventually(lambda: len(robot.device.writes) > 10)
        again = plane.emergency_stop(StopOrder(new_epoch(), "tester"))["settler"]
        assert "settling" not in again.fields()
        frozen = dict(robot.device.positions)
        assert robot.device.limp == []
        assert frozen != REST
        assert robot.device.positions == frozen


def test_an_arm_that_has_not_moved_is_only_frozen(robot: HardwareRobot) -> None:
    assert robot.halt("test").settling is False
    assert robot.device.limp == []


def test_after_it_settled_a_stop_leaves_it_limp_and_a_motion_makes_it_stiff_where_it_is(robot: HardwareRobot) -> None:
    moved(robot).halt("test")
    robot.wait_settled()
    assert robot.halt("again").stopped is True
    assert robot.device.limp == ["pan", "lift", "grip"]
    # It was pushed aside while it was limp.
    robot.device.positions["pan.pos"] = -30.0
    written = len(robot.device.writes)
    assert robot.send_action({"lift.pos": 20.0})["status"] == "success"
    assert robot.device.writes[written].action["pan.pos"] == -30.0
    assert robot.device.limp == []
    assert robot.device.positions["pan.pos"] == -30.0
    assert robot.halt("test").settling is True, "it has moved since"


def test_something_in_its_way_ends_the_settling_with_torque_and_an_event(
    robot: HardwareRobot, caplog: pytest.LogCaptureFixture
) -> None:
    events: list[RolloutEvent] = []
    robot.subscribe(events.append)
    moved(robot)
    robot.device.stuck = {"lift.pos"}
    robot.halt("test")
    assert "lift.pos is" in robot.wait_settled()
    assert robot.device.limp == []
    assert robot.device.writes[-1].action == robot.device.positions, "it holds where it is, and pushes no further"
    eventually(lambda: any(event.kind == "finished" and event.policy == "settle" for event in events))
    assert "in its way" in events[-1].error
    assert flush_audit(60.0)
    assert [record for record in read_audit_log() if "settle_failed" in record.values()]
    assert [record for record in caplog.records if record.levelname == "CRITICAL" and "settle" in record.message]


def test_a_bus_that_fails_ends_the_settling_with_torque(robot: HardwareRobot) -> None:
    moved(robot)
    failures: list[int] = []

    def fail() -> None:
        # As often as a write is tried.
        if len(robot.device.writes) > 6 and len(failures) < 3:
            failures.append(1)
            raise ConnectionError("no status packet")

    robot.device.before_write = fail
    robot.halt("test")
    assert "no status packet" in robot.wait_settled()
    assert robot.device.limp == []
    unsettled = robot.cleanup()
    assert unsettled["status"] == "error", "its torque would go off with the connection"
    assert robot.device.is_connected


def test_the_end_of_the_process_waits_until_it_has_settled() -> None:
    robot = HardwareRobot(TorqueDevice(), "ending", stop_level="settle", rest_pose=REST)
    robot.connect()
    assert moved(robot).cleanup()["status"] == "success"
    assert robot.device.positions == REST
    assert robot.device.limp == ["pan", "lift", "grip"]
    assert not robot.device.is_connected


def test_a_task_may_settle_within_the_time_of_the_longest_way() -> None:
    device = TorqueDevice()
    device.positions = {"pan.pos": 100.0, "lift.pos": 100.0, "grip.pos": 100.0}
    robot = HardwareRobot(device, "far", stop_level="settle", rest_pose={**REST, "pan.pos": -100.0})
    robot.connect()
    robot.send_action({"pan.pos": 100.0})
    began = time.monotonic()
    robot.halt("test")
    robot.wait_settled()
    assert time.monotonic() - began >= 1 / RANGES_PER_S - 0.1, "never faster, whatever the machine does"
    robot.cleanup()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stop_level": "settle"}, "needs a rest_pose"),
        ({"stop_level": "settle", "rest_pose": 3}, "rest_pose must be"),
        ({"stop_level": "settle", "rest_pose": {"pan.pos": 0.0}}, "lacks lift.pos, grip.pos"),
        ({"stop_level": "settle", "rest_pose": {**REST, "tail.pos": 0.0}}, "tail.pos"),
        ({"stop_level": "settle", "rest_pose": {**REST, "grip.pos": 101.0}}, r"rest_pose\['grip.pos'\].* 0 to 100"),
        ({"stop_level": "settle", "rest_pose": {**REST, "grip.pos": math.nan}}, r"rest_pose\['grip.pos'\]"),
        ({"stop_level": "settle", "rest_pose": {**REST, "grip.pos": True}}, r"rest_pose\['grip.pos'\]"),
        (
            {"stop_level": "settle", "rest_pose": REST, "joint_ranges": {"pan.pos": (-math.inf, math.inf)}},
            "needs joint_ranges for pan.pos",
        ),
        ({"rest_pose": {"pan.pos": 0.0}}, "lacks lift.pos"),
    ],
)
def test_a_robot_that_could_not_settle_is_refused_when_it_is_made(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        HardwareRobot(TorqueDevice(), "arm", **options)


def test_the_setting_asks_for_a_rest_pose_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "settle")
    with pytest.raises(ValidationError, match=r"STRANDS_ESTOP_TORQUE.* needs a rest_pose"):
        HardwareRobot(TorqueDevice(), "arm")


def test_a_robot_without_torque_to_switch_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"bus\.disable_torque"):
        HardwareRobot(RecordingDevice(), "arm", stop_level="settle", rest_pose=REST)


@pytest.mark.parametrize("level", ["limp", "release"])
def test_limp_and_its_older_name_take_the_torque_off(level: Any) -> None:
    robot = HardwareRobot(TorqueDevice(), "arm", stop_level=level)
    robot.connect()
    assert robot.halt("test").stopped is True
    assert robot.device.limp == ["pan", "lift", "grip"]
    robot.cleanup()


class SlowToInterrupt(ScriptedPolicy):
    """Waits in its second call for ``act_returns``, and in its interruption for ``interruption_returns``."""

    def __init__(self) -> None:
        super().__init__([{"pan.pos": 20.0}], always=self._wait)
        self.acts, self.act_returns = threading.Event(), threading.Event()
        self.interruption_returns = threading.Event()

    def _wait(self) -> None:
        self.acts.set()
        self.act_returns.wait(120)

    def interrupt(self) -> None:
        super().interrupt()
        self.interruption_returns.wait(120)


@pytest.fixture
def slow(robot: HardwareRobot, monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowToInterrupt]:
    """The policy of a task of ``robot`` that runs."""
    policy = SlowToInterrupt()
    with monkeypatch.context() as patched:
        patched.setattr(task_engine, "create_policy", lambda name, **options: policy)
        assert robot.start_task("wave")["status"] == "success"
    assert policy.acts.wait(20)
    yield policy
    policy.act_returns.set()
    policy.interruption_returns.set()


def test_an_arm_that_moves_again_before_its_stop_is_judged_does_not_settle(
    robot: HardwareRobot, slow: SlowToInterrupt, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = stop_executor().submit(robot, "settler", "test", within=600)
    assert slow.interrupted.wait(20)
    slow.act_returns.set()
    eventually(lambda: not robot.occupied("settler"))
    monkeypatch.setattr(task_engine, "create_policy", lambda name, **options: ScriptedPolicy([], {"pan.pos": 9.0}))
    assert robot.start_task("again")["status"] == "success"
    slow.interruption_returns.set()
    assert (stop.result(20).stopped, stop.result(20).settling) == (True, False)
    assert robot.get_task_status()["task_status"] == "running"
    assert robot.get_task_status()["settling"] != "settling"


def test_an_arm_whose_stop_was_answered_by_its_deadline_does_not_settle_later(
    robot: HardwareRobot, slow: SlowToInterrupt
) -> None:
    late: list[StopVerdict] = []
    stop = stop_executor().submit(robot, "settler", "test", within=0.5, answered=late.append)
    assert stop.result(20).settling is False
    slow.act_returns.set()
    slow.interruption_returns.set()
    eventually(lambda: len(late) == 2, what="the late verdict")
    assert (late[1].stopped, late[1].settling) == (True, False)
    assert robot.get_task_status()["settling"] != "settling"


def test_of_two_stops_the_later_one_says_that_the_arm_settles(robot: HardwareRobot, slow: SlowToInterrupt) -> None:
    stops = []
    for _ in range(2):
        written = len(robot.device.writes)
        stops.append(stop_executor().submit(robot, "settler", "test", within=600))
        eventually(lambda written=written: len(robot.device.writes) > written)  # type: ignore[misc]
    slow.act_returns.set()
    slow.interruption_returns.set()
    assert [each.result(20).stopped for each in stops] == [True, True]
    assert stops[1].result(20).settling is True
