"""Ends of leases behind something foreign that hangs: a status, an observer, a world, a log."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import eventually

from strands_robots.serving import control
from strands_robots.serving.control import ControlChange, ControlLease, LeaseWatch, NotHolderError
from strands_robots.serving.control_leases import leases_of
from strands_robots.serving.workers import UNBOUNDED, BoundedCall

SECRET = "a secret of agent-a"
TTL_S = 0.2
PROMPTLY_S = 5.0
"""Long for a loaded machine, and far below the time for which a wedge of these tests lasts."""


@pytest.fixture
def wedge() -> Iterator[threading.Event]:
    """Set to free what hangs."""
    free = threading.Event()
    yield free
    free.set()


@pytest.fixture
def robot(wedge: threading.Event) -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    wedge.set()
    toy.close()


def moved(robot: ToyRobot) -> ControlLease:
    """Have agent-a move the robot for a short time; return the lease."""
    lease = leases_of(robot, hardware=False).of()
    leave = lease.admit("execute", "agent-a", SECRET, TTL_S)
    assert robot.start_task("wave", duration=300.0)["status"] == "success"
    leave.settle()
    return lease


def halted(robot: ToyRobot) -> bool:
    return not any(each.running for each in robot.rollouts.values())


def test_robot_whose_status_hangs_is_halted_at_the_end_of_its_lease(robot: ToyRobot, wedge: threading.Event) -> None:
    robot.before["get_task_status"] = wedge.wait
    lease = moved(robot)
    eventually(lambda: halted(robot), PROMPTLY_S, "the halt")
    assert lease.due is None


def test_status_that_hangs_holds_up_no_call_for_long(robot: ToyRobot, wedge: threading.Event) -> None:
    lease = leases_of(robot, hardware=False).of()
    lease.admit("execute", "agent-a", SECRET, 60.0).settle()
    robot.before["get_task_status"] = wedge.wait
    began = time.monotonic()
    for _ in range(50):
        assert lease.renew(SECRET)["status"] == "success"
        assert lease.facts()["holder"] == "agent-a"
        with pytest.raises(NotHolderError):
            lease.acquire("agent-b", "agent", 60.0)
    assert time.monotonic() - began < PROMPTLY_S
    assert lease.take("ann", "because", "toy", None)["status"] == "success"


def test_status_that_hangs_occupies_one_thread(robot: ToyRobot, wedge: threading.Event) -> None:
    lease = leases_of(robot, hardware=False).of()
    lease.admit("execute", "agent-a", SECRET, 60.0).settle()
    inside: list[str] = []

    def hang() -> None:
        inside.append(threading.current_thread().name)
        wedge.wait()

    robot.before["get_task_status"] = hang
    for _ in range(20):
        lease.renew(SECRET)
    assert len(inside) == 1


def test_observer_that_hangs_delays_no_halt(robot: ToyRobot, wedge: threading.Event) -> None:
    leases_of(robot, hardware=False).observe(lambda change: wedge.wait())
    lease = leases_of(robot, hardware=False).of()
    for _ in range(3):
        lease.release(str(lease.acquire("agent-a", "agent", 60.0)["lease_id"]))
    moved(robot)
    eventually(lambda: halted(robot), PROMPTLY_S, "the halt")
    assert lease.take("ann", "because", "toy", None)["status"] == "success"


def test_observers_are_told_in_the_order_of_the_changes(robot: ToyRobot) -> None:
    changes: list[ControlChange] = []
    leases = leases_of(robot, hardware=False)
    leases.observe(changes.append)
    for number in range(50):
        leases.of().release(str(leases.of().acquire(f"agent-{number}", "agent", 60.0)["lease_id"]))
    eventually(lambda: len(changes) == 100, what="every change")
    told = [(each.event, each.holder) for each in changes]
    assert told == [(event, f"agent-{number}") for number in range(50) for event in ("acquired", "released")]


def test_log_that_blocks_delays_no_halt(robot: ToyRobot, wedge: threading.Event) -> None:
    class Blocked(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            wedge.wait()

    log, blocked = logging.getLogger("strands_robots.serving.control"), Blocked()
    other = ToyRobot("other")
    log.addHandler(blocked)
    try:
        for each in (robot, other):
            moved(each)
        eventually(lambda: halted(robot) and halted(other), PROMPTLY_S, "both halts")
    finally:
        wedge.set()
        log.removeHandler(blocked)
        other.close()


def test_world_that_hangs_is_asked_for_nothing_before_the_stop_of_its_robot(wedge: threading.Event) -> None:
    class Hanging(ToyWorld):
        wedged = False

        def list_robots(self) -> list[str]:
            if self.wedged:
                wedge.wait()
            return super().list_robots()

        def list_policies_running(self) -> list[dict[str, Any]]:
            if self.wedged:
                wedge.wait()
            return super().list_policies_running()

    world = Hanging()
    try:
        lease = leases_of(world, hardware=False).of("left")
        leave = lease.admit("execute", "agent-a", SECRET, TTL_S)
        for name in ("left", "right"):
            assert world.start_policy(name, "wave", duration=300.0)["status"] == "success"
        leave.settle()
        world.wedged = True
        eventually(lambda: not world.rollouts["left"].running, PROMPTLY_S, "the stop of one robot")
        assert world.rollouts["right"].running
    finally:
        wedge.set()
        world.close()


def test_robot_that_may_still_move_is_named_after_its_lease(
    robot: ToyRobot, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot.stubborn = True
    moved(robot)
    eventually(lambda: "toy may still move after the end of a lease" in caplog.text, what="the log")


def test_human_who_takes_a_robot_that_does_not_stop_is_told(robot: ToyRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot.stubborn = True
    answer = moved(robot).take("ann", "because", "toy", None)
    assert answer["status"] == "success"
    assert "toy may still move" in answer["content"][0]["text"]


def test_watch_that_could_not_start_its_thread_starts_it_later(monkeypatch: pytest.MonkeyPatch) -> None:
    watch, ended = LeaseWatch(), threading.Event()
    lease = ControlLease("arm-1", lambda reason: ended.set(), lambda: False, watched=watch.add)

    class NoThread(threading.Thread):
        def start(self) -> None:
            raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(control.threading, "Thread", NoThread)
        with pytest.raises(RuntimeError):
            lease.acquire("agent-a", "agent", 0.05)
    assert lease.facts()["held"] is False
    lease.acquire("agent-a", "agent", 0.05)
    assert ended.wait(20.0)


def test_lease_that_is_renewed_while_it_ends_is_watched_again() -> None:
    watch, halts = LeaseWatch(), threading.Event()
    asked, answered = threading.Event(), threading.Event()

    class Renewed:
        """Renewed once, in the very moment in which the watch ends it."""

        def __init__(self) -> None:
            self.due: float | None = time.monotonic()

        def expire(self, ahead: float) -> None:
            if asked.is_set():
                self.due = None
                halts.set()
                return
            asked.set()
            answered.wait()
            self.due = time.monotonic()

    watch.add(Renewed())
    assert asked.wait(20.0)
    eventually(lambda: not watch.running, what="a watch without a lease")
    answered.set()
    assert halts.wait(20.0)


class Counted:
    """A call that answers with its number, and hangs while the test lets it."""

    def __init__(self) -> None:
        self.begun = 0
        self.free = threading.Event()

    def __call__(self) -> int:
        self.begun += 1
        number = self.begun
        self.free.wait()
        return number


def test_answer_of_a_bounded_call_is_never_older_than_its_question() -> None:
    counted = Counted()
    bounded = BoundedCall(counted)
    with pytest.raises(TimeoutError):
        bounded(0.02)
    later = UNBOUNDED.call(lambda: bounded(20.0))
    assert not later.done()
    counted.free.set()
    assert later.result(20.0) == 2


def test_call_that_hangs_is_awaited_once() -> None:
    counted = Counted()
    bounded = BoundedCall(counted)
    try:
        with pytest.raises(TimeoutError):
            bounded(0.2)
        began = time.monotonic()
        for _ in range(1000):
            with pytest.raises(TimeoutError):
                bounded(0.2)
        assert time.monotonic() - began < 1000 * 0.2 / 10
        assert counted.begun == 1
    finally:
        counted.free.set()


def test_error_of_a_bounded_call_is_the_callers() -> None:
    def fail() -> None:
        raise OSError("no bus")

    with pytest.raises(OSError, match="no bus"):
        BoundedCall(fail)(20.0)
