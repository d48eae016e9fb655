"""Stops of a base: zeros until it is still, and an honest word of what is known."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.ros_bases import TOPIC, FaultyLink, Lock, Made, memory, none_left, velocities
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually

from strands_robots.ros.link import OnMessage, RosError, Unwatch
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import Outcome, grade


def holding_by_count(monkeypatch: pytest.MonkeyPatch, held: int, count: Callable[[], int]) -> SimpleNamespace:
    """A hold's clock that goes by ``count`` instead of seconds: blind, it lasts for ``held`` of them."""
    clock = SimpleNamespace(monotonic=lambda: float(count()))
    monkeypatch.setattr("strands_robots.drivers.ros.velocity.time", clock)
    monkeypatch.setattr("strands_robots.drivers.ros.velocity.BLIND_HOLD_S", float(held))
    return clock


def passes_while_looking(monkeypatch: pytest.MonkeyPatch) -> None:
    """A halt's time passes only while it looks at odometry: a thread that starts late costs nothing of it."""
    passed = [0.0]

    def sleep(seconds: float) -> None:
        passed[0] += seconds

    clock = SimpleNamespace(monotonic=lambda: passed[0], sleep=sleep)
    monkeypatch.setattr("strands_robots.drivers.ros.mobile_base.time", clock)


def test_stop_ends_a_running_drive_and_only_zeros_follow(made: Made) -> None:
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


def test_new_drive_ends_the_zeros_of_the_previous_stop(made: Made) -> None:
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


def test_base_without_odometry_gets_zeros_for_the_blind_hold_only(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = made(publish_rate=200.0)
    holding_by_count(monkeypatch, 10, lambda: len(memory(robot).sent))
    robot.halt()
    eventually(lambda: not robot.holding)
    assert velocities(memory(robot)) == [(0.0, 0.0)] * 11


def test_link_that_returns_late_gets_zeros_for_the_whole_hold_time(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    link = FaultyLink(tuple(range(1, 10_000)))
    holding_by_count(monkeypatch, 10, lambda: link.tries)
    robot = made(link, publish_rate=50.0)
    assert robot.halt().stopped is False
    eventually(lambda: link.tries > 25, what="tries beyond the time of a blind hold")
    link.faults = ()
    eventually(lambda: not robot.holding)
    assert len(link.sent) == 11, "as many as a link that was never down gets"


def test_link_that_drops_out_during_a_hold_restarts_the_hold_time(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    link = FaultyLink(tuple(range(4, 30)))
    holding_by_count(monkeypatch, 10, lambda: link.tries)
    robot = made(link, publish_rate=200.0)
    assert robot.halt().stopped
    eventually(lambda: not robot.holding)
    assert len(link.sent) == 3 + 11, "three before the drop-out and the whole time after it"


def test_hold_on_a_dead_link_ends_when_the_base_disconnects(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("strands_robots.drivers.ros.velocity.BLIND_HOLD_S", 0.05)
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot = made(FaultyLink(tuple(range(1, 10_000))), publish_rate=50.0)
    robot.halt()
    time.sleep(0.2)
    assert robot.holding
    robot.disconnect()
    assert not robot.holding


def test_hold_time_restarts_at_the_last_odometry_sample_of_a_moving_base(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    link, speaks_until = MemoryLink(), 40
    clock = holding_by_count(monkeypatch, 15, lambda: len(velocities(link)))
    monkeypatch.setattr("strands_robots.drivers.ros.velocity.time", clock)
    monkeypatch.setattr("strands_robots.drivers.ros.velocity.FRESH_S", 5.0)
    robot = made(link, odom_topic="/odom", publish_rate=100.0)
    link.watch(TOPIC, None, lambda _: tell_speed(link, 1.0) if len(velocities(link)) <= speaks_until else None)
    robot.drive(1.0)
    robot.halt()
    eventually(lambda: not robot.holding)
    # Its last word counts for 5, and from then on it is blind.
    assert len(velocities(link)) == speaks_until + 5 + 15


def test_slow_type_lookup_does_not_delay_the_zeros(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    passes_while_looking(monkeypatch)

    class Slow(MemoryLink):
        free = threading.Event()
        watchers = 0

        def watch(self, topic: str, kind: str | None, received: OnMessage) -> Unwatch:
            self.free.wait(60)
            unwatch = super().watch(topic, kind, received)
            self.watchers += 1

            def done() -> None:
                unwatch()
                self.watchers -= 1

            return done

    link = Slow()
    robot = made(link, odom_topic="/odom", publish_rate=100.0)
    assert robot.halt().stopped is None
    try:
        eventually(lambda: len(link.sent) > 10, what="zeros while the watch still blocks")
    finally:
        link.free.set()
    robot.disconnect()
    assert link.watchers == 0, "a watch that came late does not outlive the base"


class OpeningLink(MemoryLink):
    """Opens at its first use, as a link of DDS does, and has a base at rest behind it."""

    def __init__(self) -> None:
        super().__init__()
        self.is_open = False
        self.watchers = 0

    def publish(self, topic: str, kind: str, fields: Mapping[str, Any]) -> None:
        self.is_open = True
        super().publish(topic, kind, fields)
        super().publish("/odom", "nav_msgs/msg/Odometry", {"twist": {"twist": fields}})

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        self.is_open, unwatch = True, super().watch(topic, kind, on_message)
        self.watchers += 1

        def done() -> None:
            unwatch()
            self.watchers -= 1

        return done

    def close(self) -> None:
        self.is_open = False


def test_stop_of_a_base_that_left_the_graph_sends_its_zeros_and_leaves_it_again(made: Made) -> None:
    link = OpeningLink()
    robot = made(link, odom_topic="/odom", publish_rate=100.0)
    robot.disconnect()
    assert robot.halt("the lease of control is over").stopped is True
    assert set(velocities(link)) == {(0.0, 0.0)}
    eventually(lambda: not robot.holding and not link.is_open and not link.watchers, what="the end of the link")
    assert robot.drive(0.3, duration=0.05)["status"] == "success"
    assert robot.halt("while it is in the graph").stopped is True
    eventually(lambda: not robot.holding)
    assert link.is_open and link.watchers == 1


def test_halt_on_a_blocked_link_answers_not_stopped_in_time(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    link = FaultyLink()
    robot = made(link)
    link.free.clear()
    verdict = robot.halt()
    link.free.set()
    assert verdict.elapsed_ms < 5000, "it answers by its deadline, and not when its patience ends"
    assert verdict.stopped is False
    assert "in time" in verdict.not_stopped["velocity"]


def test_halt_that_the_link_refuses_gives_the_reason_and_retries(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "1")
    robot = made(FaultyLink(tuple(range(1, 100_000))))
    verdict = robot.halt()
    assert verdict.stopped is False
    assert "was lost" in verdict.not_stopped["velocity"]
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")
    retried = made(FaultyLink((1, 2)))
    assert retried.halt().stopped is True


def tell_speed(link: MemoryLink, speed: float) -> None:
    still = {"x": 0.0, "y": 0.0, "z": 0.0}
    twist = {"linear": {**still, "x": speed}, "angular": still}
    link.publish("/odom", "nav_msgs/msg/Odometry", {"twist": {"twist": twist}})


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
            tell_speed(self._link, self.speed)


def test_stop_with_odometry_waits_until_the_base_is_still(made: Made) -> None:
    link = MemoryLink()
    robot = made(link, odom_topic="/odom", publish_rate=50.0)
    wheels = Wheels(link, 1.0, 0.05)
    try:
        verdict = robot.halt()
        assert verdict.stopped is True
        assert wheels.speed <= 0.01
        assert verdict.elapsed_ms > 150
        eventually(lambda: not robot.holding)
        sent = len(velocities(link))
        time.sleep(0.1)
        assert len(velocities(link)) == sent, "a base that is still gets no more zeros"
    finally:
        wheels.close()


def test_rolling_base_did_not_stop_and_silent_odometry_is_unknown(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    passes_while_looking(monkeypatch)
    monkeypatch.setattr("strands_robots.drivers.ros.velocity.FRESH_S", 60.0)
    link = MemoryLink()
    link.watch(TOPIC, None, lambda _: tell_speed(link, 1.0))
    robot = made(link, odom_topic="/odom", publish_rate=50.0)
    robot.drive(1.0)
    verdict = robot.halt()
    assert verdict.stopped is False
    assert "1.00 m/s" in verdict.not_stopped["drive"]
    assert made(odom_topic="/odom").halt().stopped is None


def test_stop_with_silent_odometry_is_no_success_by_any_verb(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    passes_while_looking(monkeypatch)
    robot = made(odom_topic="/odom")
    tool = next(each for each in robot.tools if each.tool_name == "stop_rover")
    for stop in (robot.stop, robot.stop_task, tool, lambda: robot.halt("stop").envelope()):
        answer = stop()
        assert (answer["status"], answer["stopped"]) == ("error", None)
        assert "/odom is silent" in answer["reason"]
        assert grade(answer) is Outcome.UNKNOWN


def test_stop_whose_zero_fails_is_an_error_with_silent_odometry_too(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    answer = made(FaultyLink(tuple(range(1, 10_000))), odom_topic="/odom").stop()
    assert (answer["status"], answer["stopped"]) == ("error", False)


def test_drive_without_a_thread_leaves_a_running_hold_running(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_halt_without_a_thread_still_sends_a_zero(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = made()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        assert robot.halt().stopped
    assert velocities(memory(robot)) == [(0.0, 0.0)]


def test_zeros_go_out_at_least_once_a_second_at_any_rate(made: Made) -> None:
    link = MemoryLink()
    robot = made(link, publish_rate=1e-300)
    assert robot.halt().stopped
    eventually(lambda: len(link.sent) >= 2)


class TwoWays(MemoryLink):
    """A link with a second way, which is there or not."""

    def __init__(self, second: type[Exception] | None = None) -> None:
        super().__init__()
        self.urgent: list[Mapping[str, Any]] = []
        self._second = second

    def prepare_urgent(self, topic: str, kind: str) -> None:
        """It is ready."""

    def publish_urgent(self, topic: str, kind: str, fields: Mapping[str, Any]) -> None:
        if self._second is not None:
            raise self._second("no second way")
        self.urgent.append(fields)

    def cut(self) -> None:
        pytest.fail("nothing is clogged")


@pytest.mark.parametrize(("second", "urgent", "behind"), [(None, 1, 0), (RosError, 0, 1), (RuntimeError, 0, 1)])
def test_halt_without_a_thread_sends_a_zero_over_the_connection_that_exists(
    made: Made, monkeypatch: pytest.MonkeyPatch, second: type[Exception] | None, urgent: int, behind: int
) -> None:
    link = TwoWays(second)
    robot = made(link)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        assert robot.halt().stopped
    assert (len(link.urgent), velocities(link)) == (urgent, [(0.0, 0.0)] * behind)


def test_each_stop_sends_its_zero_while_odometry_is_silent(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "30")
    robot = made(odom_topic="/odom", publish_rate=1.0)
    stops = []
    for number in range(5):
        stops.append(stop_executor().submit(robot, "base", "test"))
        eventually(lambda number=number: len(memory(robot).sent) > number, what="its zero")  # type: ignore[misc]
    assert not any(each.done() for each in stops)

    def all_told() -> bool:
        tell_speed(memory(robot), 0.0)
        return all(each.done() for each in stops)

    eventually(all_told)
    assert all(each.result().stopped for each in stops)
