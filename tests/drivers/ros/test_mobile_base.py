"""The drive contract of a base: what is sent, what is refused, and the tools that agents get."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from fixtures.ros_bases import OPEN, SHUT, TOPIC, FaultyLink, Made, memory, none_left, velocities
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from strands_robots.contract import TaskRobot
from strands_robots.drivers.ros import motion
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot, PosedBaseRobot, tool_suffix
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.envelope import error
from strands_robots.ros.link import EarlierRefusedError
from strands_robots.utils import ValidationError

speed = st.floats(min_value=-5, max_value=5)


@hypothesis_settings(max_examples=60, deadline=None)
@given(linear=speed, angular=speed, duration=st.floats(min_value=1e-6, max_value=0.012))
def test_a_timed_drive_sends_its_count_and_one_zero(linear: float, angular: float, duration: float) -> None:
    link = MemoryLink()
    robot = MobileBaseRobot("rover", link, TOPIC, publish_rate=1000.0, command_gate=OPEN)
    assert robot.drive(linear, angular, duration=duration)["status"] == "success"
    sent = velocities(link)
    messages = max(1, round(duration * 1000))
    assert sent[:messages] == [(linear, angular)] * messages
    assert sent[messages:] == ([] if linear == angular == 0 else [(0.0, 0.0)])


def test_late_error_about_a_command_does_not_suppress_the_zero() -> None:
    class Complaining(MemoryLink):
        def publish(self, topic: str, kind: str, fields: Mapping[str, Any]) -> None:
            if len(self.sent) == 3 and not self.complained:
                self.complained = True
                raise EarlierRefusedError("the server refused message 3")
            super().publish(topic, kind, fields)

        complained = False

    link = Complaining()
    robot = MobileBaseRobot("rover", link, TOPIC, publish_rate=2000.0, command_gate=OPEN)
    answer = robot.drive(0.5, count=3)
    assert (answer["status"], velocities(link)[-1]) == ("error", (0.0, 0.0))
    assert "the server refused message 3" in answer["reason"]


@hypothesis_settings(max_examples=60, deadline=None)
@given(
    faults=st.sets(st.integers(min_value=1, max_value=6), max_size=6),
    count=st.integers(min_value=1, max_value=5),
    linear=st.floats(min_value=0.1, max_value=3),
)
def test_repeated_drive_with_failing_messages_tries_its_zero_and_reports_the_failure(
    faults: set[int], count: int, linear: float
) -> None:
    link = FaultyLink(tuple(faults))
    robot = MobileBaseRobot("rover", link, TOPIC, publish_rate=2000.0, command_gate=OPEN)
    answer = robot.drive(linear, count=count)
    delivered = next((n - 1 for n in range(1, count + 1) if n in faults), count)
    tried = min(delivered + 1, count) + (count > 1)
    assert link.tries == tried
    zero_failed = count > 1 and tried in faults
    assert (answer["status"] == "success") == (delivered == count and not zero_failed)
    if zero_failed:
        assert "may still move" in answer["reason"]
    elif count > 1:
        assert velocities(link)[-1] == (0.0, 0.0)


@hypothesis_settings(max_examples=80, deadline=None)
@given(linear=speed, angular=speed, max_linear=st.floats(0.01, 5), max_angular=st.floats(0.01, 5))
def test_sent_velocities_never_exceed_the_limits(
    linear: float, angular: float, max_linear: float, max_angular: float
) -> None:
    link = MemoryLink()
    robot = MobileBaseRobot("rover", link, TOPIC, max_linear=max_linear, max_angular=max_angular, command_gate=OPEN)
    answer = robot.drive(linear, angular)
    ((sent_linear, sent_angular),) = velocities(link)
    assert abs(sent_linear) <= max_linear
    assert abs(sent_angular) <= max_angular
    assert (answer["linear"], answer["angular"]) == (sent_linear, sent_angular)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), True, "1", None, 10**400])
@pytest.mark.parametrize("argument", ["linear", "angular"])
def test_invalid_velocity_is_refused_before_any_other_argument(made: Made, argument: str, bad: object) -> None:
    robot = made()
    answer = robot.drive(**{argument: bad}, duration=-1)  # type: ignore[arg-type]
    assert argument in answer["reason"]
    assert memory(robot).sent == []


@pytest.mark.parametrize("bad", [0, -1.0, float("nan"), float("inf"), True, "2"])
def test_a_duration_outside_its_domain_sends_nothing(made: Made, bad: Any) -> None:
    robot = made()
    for answer in (robot.drive(0.1, duration=bad, count=0), robot.start_drive(0.1, 0.0, bad)):
        assert "duration" in answer["reason"]
    assert memory(robot).sent == []


@pytest.mark.parametrize("bad", [0, -3, 1.0, True, "2", None])
def test_a_count_outside_its_domain_sends_nothing(made: Made, bad: Any) -> None:
    robot = made()
    assert "count" in robot.drive(0.1, count=bad)["reason"]
    assert memory(robot).sent == []


def test_drive_longer_than_the_limit_is_refused_not_shortened(made: Made) -> None:
    robot = made(max_duration=0.5, publish_rate=10.0)
    assert "0.5" in robot.drive(0.1, duration=0.6)["reason"]
    assert "count must be at most 5" in robot.drive(0.1, count=6)["reason"]
    assert memory(robot).sent == []


def test_duration_takes_precedence_over_count(made: Made) -> None:
    robot = made()
    assert robot.drive(0.1, duration=0.003, count=500)["messages"] == 3


def test_single_message_latches_until_stop(made: Made) -> None:
    robot = made()
    assert "until it is stopped" in robot.drive(0.2)["content"][0]["text"]
    assert velocities(memory(robot)) == [(0.2, 0.0)]
    answer = robot.stop()
    assert (answer["status"], answer["halted"]) == ("success", ["drive"])
    assert velocities(memory(robot))[1] == (0.0, 0.0)


def test_unapproved_drive_neither_sends_nor_arms(made: Made) -> None:
    robot = made(command_gate=SHUT)
    robot.handshake = lambda *_: pytest.fail("armed")  # type: ignore[method-assign]
    assert "needs operator approval" in robot.drive(0.1)["reason"]
    assert "needs operator approval" in robot.drive(0.0)["reason"], "a raw zero is a command like any other"
    assert memory(robot).sent == []


def test_stop_needs_no_approval(made: Made) -> None:
    robot = made(command_gate=SHUT)
    assert robot.stop()["status"] == "success"
    assert velocities(memory(robot))[0] == (0.0, 0.0)


def test_a_failed_handshake_aborts_the_drive(made: Made) -> None:
    robot = made()
    robot.handshake = lambda *_: error("the vehicle refuses")  # type: ignore[method-assign]
    assert robot.drive(0.1)["reason"] == "the vehicle refuses"
    assert memory(robot).sent == []
    robot.handshake = lambda *_: None  # type: ignore[method-assign]
    assert robot.drive(0.1)["status"] == "success"


def test_halt_during_the_handshake_lets_only_zeros_out(made: Made) -> None:
    robot = made()

    def shake(*_: object) -> None:
        robot.halt("in between")

    robot.handshake = shake  # type: ignore[method-assign]
    answer = robot.drive(0.5, duration=0.01)
    assert "A stop ended the drive after 0" in answer["reason"]
    assert set(velocities(memory(robot))) == {(0.0, 0.0)}


def test_reads_return_a_sample_or_the_reason(made: Made) -> None:
    link = MemoryLink()
    robot = made(link, odom_topic="/odom")
    assert "timeout" in robot.get_pose(0)["reason"]
    assert "Nothing arrived" in robot.get_pose(0.01)["reason"]
    assert "scan_topic" in robot.get_scan()["reason"]
    read = threading.Event()

    def tell() -> None:
        while not read.wait(0.02):
            link.publish("/odom", "nav_msgs/msg/Odometry", {"pose": 1})

    telling = threading.Thread(target=tell)
    telling.start()
    try:
        assert robot.get_pose(20.0)["message"] == {"pose": 1}
    finally:
        read.set()
        telling.join()


def test_a_base_fits_the_robot_contract_and_runs_no_policies(made: Made) -> None:
    robot = made()
    assert isinstance(robot, TaskRobot)
    assert "runs no policies" in robot.start_task("roll")["reason"]
    assert robot.get_task_status()["task_status"] == "idle"
    assert robot.cleanup()["stopped"] is True


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("publish_rate", 0),
        ("publish_rate", float("inf")),
        ("max_linear", 0),
        ("max_angular", -1),
        ("max_duration", "3"),
    ],
)
def test_invalid_limit_is_refused_at_construction(made: Made, option: str, value: object) -> None:
    with pytest.raises(ValidationError, match=option):
        made(**{option: value})


def test_tools_have_the_robots_name_and_describe_every_parameter(made: Made) -> None:
    robot = made(odom_topic="/odom")
    specs = {tool.tool_name: tool.tool_spec for tool in robot.tools}
    assert set(specs) == {"drive_rover", "stop_rover", "status_rover", "get_pose_rover"}
    drive = specs["drive_rover"]["inputSchema"]["json"]
    assert drive["required"] == ["linear", "angular", "duration"]
    for spec in specs.values():
        for name, parameter in spec["inputSchema"]["json"]["properties"].items():
            assert len(parameter["description"]) > 10, name
            assert not parameter["description"].startswith("Parameter")


def test_agent_that_misspells_an_argument_of_drive_is_refused_by_name_and_stops_all_the_same(made: Made) -> None:
    link = MemoryLink()
    drive, stop, status, _ = made(link, odom_topic="/odom").tools
    given = {"linear": 0.2, "angular": 0.0, "duration": 1.0, "durration": 0.1}
    with pytest.raises(ValidationError, match=r"drive_rover takes linear, angular, duration.*durration"):
        drive.stream({"toolUseId": "1", "name": "drive_rover", "input": given}, {})
    for tool in (stop, status):
        tool.stream({"toolUseId": "1", "name": tool.tool_name, "input": {"durration": 0.1}}, {})


class CutOff(MemoryLink):
    """A Ctrl-C comes right after a message of this number, counted from 1, went out."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.after = after

    def publish(self, topic: str, kind: str, fields: Mapping[str, Any]) -> None:
        super().publish(topic, kind, fields)
        if len(self.sent) == self.after:
            raise KeyboardInterrupt


@pytest.mark.parametrize(("order", "left"), [({"duration": 0.1}, ()), ({}, ("drive",))], ids=["timed", "single"])
def test_ctrl_c_makes_a_drive_an_error_and_a_single_message_still_latches(
    made: Made, order: dict[str, Any], left: tuple[str, ...]
) -> None:
    robot = made(CutOff(1))
    events: list[tuple[str, str, str]] = []
    robot.subscribe(lambda event: events.append((event.kind, event.state, event.error)))
    with pytest.raises(KeyboardInterrupt):
        robot.drive(0.5, **order)
    assert events[1] == (
        "finished",
        "error",
        f"The drive failed after 0 of {100 if order else 1} messages: it was interrupted.",
    )
    assert robot.get_task_status()["task_status"] == "error"
    assert velocities(memory(robot)) == ([(0.5, 0.0)] if left else [(0.5, 0.0), (0.0, 0.0)])
    assert robot.halt("test").halted == left


def test_drive_without_a_thread_ends_only_once_the_base_is_free(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, busy = made(), list[bool]()

    class EndAndDriveAgain(threading.Event):
        def set(self) -> None:
            if not busy:
                busy.append(True)
                busy[0] = "being driven" in robot.drive(0.1).get("reason", "")
            super().set()

    monkeypatch.setattr(motion, "threading", SimpleNamespace(Event=EndAndDriveAgain))
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        assert "could not begin" in robot.start_drive(0.1, 0.0, 0.01)["reason"]
    assert busy == [False]


def test_drive_without_a_thread_leaves_the_base_free(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = made()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        assert "could not begin" in robot.start_drive(0.1, 0.0, 0.01)["reason"]
    assert (robot.get_task_status()["task_status"], robot.holding) == ("error", False)
    assert robot.halt().stopped
    assert robot.drive(0.1, 0.0, duration=0.01)["status"] == "success"


@pytest.mark.parametrize("huge", [1e308, 1e30])
def test_excessive_time_is_refused_by_name(made: Made, huge: float) -> None:
    robot = made(odom_topic="/odom", scan_topic="/scan")
    for answer in (robot.drive(0.1, duration=huge), robot.start_drive(0.1, 0.0, huge)):
        assert "duration must be at most" in answer["reason"]
    for answer in (robot.get_pose(huge), robot.get_scan(huge)):
        assert "timeout" in answer["reason"]
    assert memory(robot).sent == []


@pytest.mark.parametrize("count", [10**13, 10**5000], ids=["many", "more"])
def test_excessive_count_is_refused_by_name(made: Made, count: int) -> None:
    robot = made(max_duration=1e308)
    assert "count" in robot.drive(0.1, count=count)["reason"]
    assert "duration" in robot.drive(0.1, duration=1e308)["reason"]
    assert robot.drive(0.1)["status"] == "success"


def test_drive_at_an_extremely_low_rate_still_ends_with_a_stop(made: Made) -> None:
    robot = made(publish_rate=1e-300)
    assert robot.start_drive(0.1, 0.0, 300.0)["status"] == "success"
    eventually(lambda: velocities(memory(robot)) == [(0.1, 0.0)])
    assert robot.halt().stopped
    assert robot.get_task_status()["task_status"] == "stopped"


def test_only_a_base_with_odometry_has_a_pose() -> None:
    assert not hasattr(MobileBaseRobot("rover", MemoryLink(), TOPIC), "get_pose")
    assert PosedBaseRobot("rover", MemoryLink(), TOPIC, odom_topic="/odom", scan_topic="/s").reads == (
        "get_pose",
        "get_scan",
    )


def test_tool_names_are_unique_and_accepted_by_model_apis() -> None:
    names = ["rover", "rover-2", "a.b", "a_b", "a-b", "x" * 55, "x" * 56, "x" * 128, "x" * 127 + ".", "a." * 60]
    suffixes = [tool_suffix(name) for name in names]
    assert suffixes[:2] == ["rover", "rover-2"]
    assert len(set(suffixes)) == len(names)
    for name in names:
        robot = PosedBaseRobot(name, MemoryLink(), TOPIC, odom_topic="/odom", scan_topic="/scan")
        assert all(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", tool.tool_name) for tool in robot.tools)
    robot = RosBridgedRobot("y" * 128, TOPIC, "/odom", nav_action="/navigate_to_pose")
    assert all(len(tool.tool_name) <= 64 for tool in robot.tools)


@pytest.fixture
def restless() -> Iterator[None]:
    """Threads take turns so often that none does two things in one turn."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("restless")
def test_base_accepts_the_next_drive_once_the_last_is_reported_over(made: Made) -> None:
    robot = made()
    for _ in range(300):
        answer = robot.start_drive(0.1, 0.0, 0.001)
        assert answer["status"] == "success", answer
        while robot.get_task_status()["task_status"] == "running":
            pass


class WireOf05:
    """A transport as strands-robots 0.5 has it."""

    def publish(self, **message: Any) -> dict[str, Any]:
        return {"status": "success"}

    def echo(self, **topic: Any) -> dict[str, Any]:
        return {"status": "success"}


def test_link_without_the_methods_of_a_link_is_refused_with_what_it_lacks() -> None:
    wire: Any = WireOf05()
    lacks = r"^link must be .*, and WireOf05 has no read, call, watch, close\.$"
    with pytest.raises(ValidationError, match=lacks):
        RosBridgedRobot("rover", TOPIC, "/odom", link=wire)
    with pytest.raises(ValidationError, match=lacks):
        MobileBaseRobot("rover", wire, TOPIC)
    MobileBaseRobot("rover", MagicMock(), TOPIC)


def test_words_of_an_earlier_release_are_refused_as_its_order_is() -> None:
    base: Any = MobileBaseRobot
    sentence = f"not {TOPIC!r}: give MobileBaseRobot its node_name, link and command_topic in this order"
    with pytest.raises(ValidationError, match=sentence):
        base("rover", TOPIC, WireOf05())
    with pytest.raises(ValidationError, match=sentence):
        base(node_name="rover", cmd_vel_topic=TOPIC, transport=WireOf05())
    with pytest.raises(ValidationError, match="give MobileBaseRobot its node_name, link"):
        base("rover", TOPIC, transport=WireOf05())
