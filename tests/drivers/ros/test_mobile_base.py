from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
from fixtures.waiting import eventually
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from strands_robots.contract import TaskRobot
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.drivers.ros.posed_base import PosedBaseRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.tools import suffix_of
from strands_robots.envelope import Envelope, error
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import EarlierRefusedError, Heard, MemoryLink, RosError, Unwatch
from strands_robots.safety.stopping import Outcome, grade
from strands_robots.utils import ValidationError

TOPIC = "/cmd_vel"
OPEN = CommandGate(lambda _: ("cmd_vel",), lambda: False)
SHUT = CommandGate(lambda _: (), lambda: False)
Made = Callable[..., PosedBaseRobot]


class FaultyLink(MemoryLink):
    """Fails the publishes whose number, counted from 1, is in ``faults``; blocks all while ``blocked`` is set."""

    def __init__(self, faults: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.faults = faults
        self.tries = 0
        self.free = threading.Event()
        self.free.set()

    def publish(self, topic: str, kind: str, fields: Mapping[str, Any]) -> None:
        self.tries += 1
        self.free.wait()
        if self.tries in self.faults:
            raise RosError(f"message {self.tries} was lost")
        super().publish(topic, kind, fields)


class Lock:
    """A lockout."""

    def refusal(self, verb: str) -> Envelope | None:
        return error(f"{verb} is locked")


@pytest.fixture
def made() -> Iterator[Made]:
    robots: list[MobileBaseRobot] = []

    def make(link: MemoryLink | None = None, **options: Any) -> MobileBaseRobot:
        options = {"publish_rate": 1000.0, "command_gate": OPEN, **options}
        robots.append(PosedBaseRobot("rover", link or MemoryLink(), TOPIC, **options))
        return robots[-1]

    yield make
    for robot in robots:
        robot.disconnect()


def velocities(link: MemoryLink) -> list[tuple[float, float]]:
    return [(m["linear"]["x"], m["angular"]["z"]) for topic, m in list(link.sent) if topic == TOPIC]


def memory(robot: MobileBaseRobot) -> MemoryLink:
    assert isinstance(robot.link, MemoryLink)
    return robot.link


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


def test_a_late_complaint_about_a_command_does_not_cost_the_base_its_zero() -> None:
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
def test_whatever_fails_a_repeated_drive_tries_its_zero_and_tells_the_truth(
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
def test_what_is_sent_never_exceeds_the_limits(
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
def test_a_velocity_that_is_no_number_is_refused_first(made: Made, argument: str, bad: object) -> None:
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


def test_a_drive_longer_than_the_platform_allows_is_refused_not_cut(made: Made) -> None:
    robot = made(max_duration=0.5, publish_rate=10.0)
    assert "0.5" in robot.drive(0.1, duration=0.6)["reason"]
    assert "count must be at most 5" in robot.drive(0.1, count=6)["reason"]
    assert memory(robot).sent == []


def test_duration_takes_precedence_over_count(made: Made) -> None:
    robot = made()
    assert robot.drive(0.1, duration=0.003, count=500)["messages"] == 3


def test_a_bare_single_drive_latches_and_stop_ends_it(made: Made) -> None:
    robot = made()
    assert "until it is stopped" in robot.drive(0.2)["content"][0]["text"]
    assert velocities(memory(robot)) == [(0.2, 0.0)]
    answer = robot.stop()
    assert (answer["status"], answer["halted"]) == ("success", ["drive"])
    assert velocities(memory(robot))[1] == (0.0, 0.0)


def test_a_drive_that_nobody_approved_neither_sends_nor_arms(made: Made) -> None:
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


def test_a_halt_inside_the_handshake_lets_nothing_but_zeros_out(made: Made) -> None:
    robot = made()

    def shake(*_: object) -> None:
        robot.halt("in between")

    robot.handshake = shake  # type: ignore[method-assign]
    answer = robot.drive(0.5, duration=0.01)
    assert "A stop ended the drive after 0" in answer["reason"]
    assert set(velocities(memory(robot))) == {(0.0, 0.0)}


def test_a_stop_ends_a_running_drive_and_nothing_but_zeros_follows(made: Made) -> None:
    robot = made(publish_rate=100.0)
    events: list[tuple[str, str]] = []
    robot.subscribe(lambda event: events.append((event.kind, event.state)))
    assert robot.start_drive(0.5, 0.1, 30.0)["status"] == "success"
    eventually(lambda: velocities(memory(robot)))
    assert robot.get_task_status()["task_status"] == "running"
    assert "being driven" in robot.drive(0.1)["reason"]
    answer = robot.stop()
    after = len(memory(robot).sent)
    assert (answer["stopped"], answer["halted"]) == (True, ["drive"])
    eventually(lambda: len(memory(robot).sent) > after + 3, what="the hold's zeros")
    assert set(velocities(memory(robot))[after:]) == {(0.0, 0.0)}
    eventually(lambda: events == [("started", "running"), ("finished", "stopped")])
    assert robot.get_task_status()["task_status"] == "stopped"


def test_a_new_drive_ends_the_zeros_of_the_stop_before_it(made: Made) -> None:
    robot = made(publish_rate=200.0)
    robot.stop()
    assert robot.drive(0.3, duration=0.05)["status"] == "success"
    sent = velocities(memory(robot))
    first = sent.index((0.3, 0.0))
    assert sent[first : first + 10] == [(0.3, 0.0)] * 10
    assert sent[first + 10 :] == [(0.0, 0.0)]


def test_a_locked_base_refuses_to_drive_and_still_sends_zeros(made: Made) -> None:
    robot = made(publish_rate=100.0)
    robot.gate.attach(Lock())
    assert robot.drive(0.1)["reason"] == "drive is locked"
    assert memory(robot).sent == []
    assert robot.halt("lockout").stopped is True
    eventually(lambda: len(memory(robot).sent) > 3)
    assert set(velocities(memory(robot))) == {(0.0, 0.0)}


def test_a_blind_base_is_told_zeros_for_its_time_and_no_longer(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("strands_robots.drivers.ros.wire.BLIND_HOLD_S", 0.2)
    robot = made(publish_rate=50.0)
    robot.halt()
    eventually(lambda: not any(t.name == "hold-rover" for t in threading.enumerate()), within=2)
    assert 8 <= len(memory(robot).sent) <= 12


def test_a_link_that_returns_after_the_blind_hold_still_gets_zeros_for_its_whole_time(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("strands_robots.drivers.ros.wire.BLIND_HOLD_S", 0.2)
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    link = FaultyLink(tuple(range(1, 10_000)))
    robot = made(link, publish_rate=50.0)
    assert robot.halt().stopped is False
    eventually(lambda: link.tries > 25, what="tries beyond the time of a blind hold")
    link.faults = ()
    eventually(lambda: not robot.holding, within=2)
    assert 6 <= len(link.sent) <= 12, "as many as a link that was never down gets"


def test_a_link_that_drops_out_within_the_hold_gets_zeros_for_its_whole_time_again(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("strands_robots.drivers.ros.wire.BLIND_HOLD_S", 0.2)
    link = FaultyLink(tuple(range(4, 30)))
    robot = made(link, publish_rate=50.0)
    assert robot.halt().stopped
    eventually(lambda: not robot.holding, within=3)
    assert 9 <= len(link.sent) <= 15, "three before the drop-out and the whole time after it"


def test_a_hold_on_a_link_that_never_returns_ends_with_the_base(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("strands_robots.drivers.ros.wire.BLIND_HOLD_S", 0.05)
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot = made(FaultyLink(tuple(range(1, 10_000))), publish_rate=50.0)
    robot.halt()
    time.sleep(0.2)
    assert robot.holding
    robot.disconnect()
    assert not robot.holding


def test_a_moving_base_whose_odometry_falls_silent_is_held_for_the_blind_time_from_its_last_word(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("strands_robots.drivers.ros.wire.BLIND_HOLD_S", 0.3)
    monkeypatch.setattr("strands_robots.drivers.ros.odometry.FRESH_S", 0.05)
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    link = MemoryLink()
    robot = made(link, odom_topic="/odom", publish_rate=100.0)
    wheels = Wheels(link, 1.0, 0.0)
    try:
        robot.halt()
        time.sleep(0.5)
    finally:
        wheels.close()
    silent_from = len(velocities(link))
    eventually(lambda: not robot.holding, within=2)
    assert len(velocities(link)) - silent_from >= 15


def test_a_graph_that_is_asked_for_a_type_for_seconds_does_not_delay_the_zeros(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")

    class Slow(MemoryLink):
        free = threading.Event()
        watchers = 0

        def watch(self, topic: str, kind: str | None, heard: Heard) -> Unwatch:
            self.free.wait(10)
            unwatch = super().watch(topic, kind, heard)
            self.watchers += 1

            def done() -> None:
                unwatch()
                self.watchers -= 1

            return done

    link = Slow()
    robot = made(link, odom_topic="/odom", publish_rate=100.0)
    assert robot.halt().stopped is None
    try:
        eventually(lambda: len(link.sent) > 10, within=2, what="zeros while the watch still blocks")
    finally:
        link.free.set()
    robot.disconnect()
    assert link.watchers == 0, "a watch that came late does not outlive the base"


def test_a_halt_on_a_link_that_blocks_answers_in_time_that_it_did_not_stop(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    link = FaultyLink()
    robot = made(link)
    link.free.clear()
    began = time.monotonic()
    verdict = robot.halt()
    took = time.monotonic() - began
    link.free.set()
    assert verdict.stopped is False
    assert "in time" in verdict.not_stopped["velocity"]
    assert took < 0.5


def test_a_halt_that_the_link_refuses_names_why_and_tries_again(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    robot = made(FaultyLink(tuple(range(1, 10_000))))
    verdict = robot.halt()
    assert verdict.stopped is False
    assert "was lost" in verdict.not_stopped["velocity"]
    retried = made(FaultyLink((1, 2)))
    assert retried.halt().stopped is True


class Wheels:
    """Tells odometry at 100 Hz: slows down by ``brake`` m/s a sample once it gets a zero."""

    def __init__(self, link: MemoryLink, speed: float, brake: float) -> None:
        self.speed, self._brake, self._link = speed, brake, link
        self._zeroed = threading.Event()
        self._done = threading.Event()
        link.watch(TOPIC, None, lambda m: None if m["linear"]["x"] else self._zeroed.set())
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._done.wait(0.01):
            if self._zeroed.is_set():
                self.speed = max(0.0, self.speed - self._brake)
            still = {"x": 0.0, "y": 0.0, "z": 0.0}
            twist = {"linear": {**still, "x": self.speed}, "angular": still}
            self._link.publish("/odom", "nav_msgs/msg/Odometry", {"twist": {"twist": twist}})


def test_with_odometry_a_stop_waits_until_the_base_is_still(made: Made) -> None:
    link = MemoryLink()
    robot = made(link, odom_topic="/odom", publish_rate=50.0)
    wheels = Wheels(link, 1.0, 0.05)
    try:
        verdict = robot.halt()
        assert verdict.stopped is True
        assert wheels.speed <= 0.01
        assert verdict.elapsed_ms > 150
        eventually(lambda: not any(t.name == "hold-rover" for t in threading.enumerate()), within=2)
        sent = len(velocities(link))
        time.sleep(0.1)
        assert len(velocities(link)) == sent, "a base that is still gets no more zeros"
    finally:
        wheels.close()


def test_a_base_that_rolls_on_did_not_stop_and_one_that_says_nothing_is_unknown(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    link = MemoryLink()
    robot = made(link, odom_topic="/odom", publish_rate=50.0)
    wheels = Wheels(link, 1.0, 0.0)
    try:
        verdict = robot.halt()
        assert verdict.stopped is False
        assert "1.00 m/s" in verdict.not_stopped["velocity"]
    finally:
        wheels.close()
    assert made(odom_topic="/odom").halt().stopped is None


def test_a_stop_of_a_base_that_never_told_a_speed_says_what_was_done_and_what_nobody_knows(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    link = MemoryLink()
    robot = made(link, odom_topic="/odom")
    answer = robot.stop()
    assert (answer["status"], answer["stopped"]) == ("success", None)
    assert "never told a speed" in answer["content"][0]["text"]
    assert grade(answer) is Outcome.UNKNOWN
    assert grade(robot.halt()) is Outcome.UNKNOWN
    monkeypatch.setattr("strands_robots.drivers.ros.odometry.FRESH_S", 0.01)
    still = {"linear": {"x": 0.0}, "angular": {"z": 0.0}}
    link.publish("/odom", "nav_msgs/msg/Odometry", {"twist": {"twist": still}})
    fallen_silent = robot.stop()
    assert (fallen_silent["status"], fallen_silent["stopped"]) == ("error", None)


def test_a_stop_whose_zero_is_not_taken_is_an_error_also_of_a_base_that_never_told_a_speed(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    answer = made(FaultyLink(tuple(range(1, 10_000))), odom_topic="/odom").stop()
    assert (answer["status"], answer["stopped"]) == ("error", False)


def test_reads_answer_a_sample_or_why_not(made: Made) -> None:
    link = MemoryLink()
    robot = made(link, odom_topic="/odom")
    assert "timeout" in robot.get_pose(0)["reason"]
    assert "Nothing arrived" in robot.get_pose(0.01)["reason"]
    assert "scan_topic" in robot.get_scan()["reason"]
    timer = threading.Timer(0.05, lambda: link.publish("/odom", "nav_msgs/msg/Odometry", {"pose": 1}))
    timer.start()
    assert robot.get_pose(2.0)["message"] == {"pose": 1}
    timer.join()


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
def test_a_limit_that_cannot_be_kept_is_refused_at_construction(made: Made, option: str, value: object) -> None:
    with pytest.raises(ValidationError, match=option):
        made(**{option: value})


def test_the_tools_are_named_by_the_robot_and_describe_every_parameter(made: Made) -> None:
    robot = made(odom_topic="/odom")
    specs = {tool.tool_name: tool.tool_spec for tool in robot.tools}
    assert set(specs) == {"drive_rover", "stop_rover", "status_rover", "get_pose_rover"}
    drive = specs["drive_rover"]["inputSchema"]["json"]
    assert drive["required"] == ["linear", "angular", "duration"]
    for spec in specs.values():
        for name, parameter in spec["inputSchema"]["json"]["properties"].items():
            assert len(parameter["description"]) > 10, name
            assert not parameter["description"].startswith("Parameter")


def none_left(_: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_a_drive_that_gets_no_thread_leaves_the_base_free(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = made()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        assert "could not begin" in robot.start_drive(0.1, 0.0, 0.01)["reason"]
    assert (robot.get_task_status()["task_status"], robot.holding) == ("error", False)
    assert robot.halt().stopped
    assert robot.drive(0.1, 0.0, duration=0.01)["status"] == "success"


def test_a_drive_that_gets_no_thread_leaves_the_base_held_that_was_held(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = made(publish_rate=100.0)
    robot.stop()
    start = threading.Thread.start

    def no_drive(thread: threading.Thread) -> None:
        if thread.name.startswith("drive-"):
            none_left(thread)
        start(thread)

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", no_drive)
        assert "could not begin" in robot.start_drive(0.1, 0.0, 0.01)["reason"]
    assert robot.holding
    before = len(memory(robot).sent)
    eventually(lambda: len(memory(robot).sent) > before + 3, what="zeros of the hold that goes on")
    assert set(velocities(memory(robot))) == {(0.0, 0.0)}


def test_a_halt_that_gets_no_thread_sends_its_one_zero_all_the_same(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = made()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        assert robot.halt().stopped
    assert velocities(memory(robot)) == [(0.0, 0.0)]


@pytest.mark.parametrize("huge", [1e308, 1e30])
def test_a_time_that_nothing_can_wait_out_is_refused_by_name(made: Made, huge: float) -> None:
    robot = made(odom_topic="/odom", scan_topic="/scan")
    for answer in (robot.drive(0.1, duration=huge), robot.start_drive(0.1, 0.0, huge)):
        assert "duration must be at most" in answer["reason"]
    for answer in (robot.get_pose(huge), robot.get_scan(huge)):
        assert "timeout" in answer["reason"]
    assert memory(robot).sent == []


@pytest.mark.parametrize("count", [10**13, 10**5000], ids=["many", "more"])
def test_a_count_that_no_drive_ends_is_refused_by_name(made: Made, count: int) -> None:
    robot = made(max_duration=1e308)
    assert "count" in robot.drive(0.1, count=count)["reason"]
    assert "duration" in robot.drive(0.1, duration=1e308)["reason"]
    assert robot.drive(0.1)["status"] == "success"


def test_a_rate_that_is_slower_than_any_clock_still_ends_with_a_stop(made: Made) -> None:
    robot = made(publish_rate=1e-300)
    assert robot.start_drive(0.1, 0.0, 5.0)["status"] == "success"
    eventually(lambda: velocities(memory(robot)) == [(0.1, 0.0)])
    assert robot.halt().stopped
    assert robot.get_task_status()["task_status"] == "stopped"


def test_zeros_come_once_a_second_at_least_however_slow_the_rate(made: Made) -> None:
    link = MemoryLink()
    robot = made(link, publish_rate=1e-300)
    assert robot.halt().stopped
    eventually(lambda: len(link.sent) >= 2, within=4)


def test_only_a_base_with_odometry_has_a_pose_to_ask_for() -> None:
    assert not hasattr(MobileBaseRobot("rover", MemoryLink(), TOPIC), "get_pose")
    assert PosedBaseRobot("rover", MemoryLink(), TOPIC, odom_topic="/odom", scan_topic="/s").reads == (
        "get_pose",
        "get_scan",
    )


def test_tool_names_are_what_model_apis_take_and_tell_robots_apart() -> None:
    names = ["rover", "rover-2", "a.b", "a_b", "a-b", "x" * 55, "x" * 56, "x" * 128, "x" * 127 + ".", "a." * 60]
    suffixes = [suffix_of(name) for name in names]
    assert suffixes[:2] == ["rover", "rover-2"]
    assert len(set(suffixes)) == len(names)
    for name in names:
        robot = PosedBaseRobot(name, MemoryLink(), TOPIC, odom_topic="/odom", scan_topic="/scan")
        assert all(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", tool.tool_name) for tool in robot.tools)
    robot = RosBridgedRobot("y" * 128, TOPIC, "/odom", nav_action="/navigate_to_pose")
    assert all(len(tool.tool_name) <= 64 for tool in robot.tools)
