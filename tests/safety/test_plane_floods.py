"""Floods of emergency stops with fresh ids: answered from the latch and counted, and no true stop is lost in them."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.audit import read_audit_log
from strands_robots.safety import plane as plane_module
from strands_robots.safety.lockout import MAX_EPOCHS, OVERFLOW
from strands_robots.safety.orders import RobotReport, StopOrder, new_epoch
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.reporting import SOURCES_NAMED, StopCount

Add = Callable[..., RecordingRobot]


def stop(plane: SafetyPlane, source: str = "forger", epoch: str = "") -> list[RobotReport]:
    """Stop, and return what is answered at once: nothing where a halt has to answer first."""
    reports: list[RobotReport] = []
    plane.begin(StopOrder(epoch or new_epoch(), source, remote=True), reports.append)
    return reports


def filled(plane: SafetyPlane, first: str = "") -> str:
    """Lock every robot by more stops than it tells apart, and wait for all halts; the first epoch."""
    first = first or new_epoch()
    stop(plane, "safety-1", first)
    for _ in range(MAX_EPOCHS):
        stop(plane)
    eventually(lambda: all(len(each.reports) == MAX_EPOCHS for each in plane.robots.values()))
    return first


@pytest.fixture
def one_halt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the latest halt answer for all stops of a crowded robot, however long the test takes."""
    monkeypatch.setattr(plane_module, "HALT_AGAIN_S", 3600.0)


@pytest.mark.usefixtures("one_halt")
def test_a_true_stop_after_64_others_is_answered_as_stopped_each_time_it_comes(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    robot.start()
    filled(plane)
    stop(plane)
    true = new_epoch()
    for _ in range(3):
        (report,) = stop(plane, "safety-1", true)
        assert (report.epoch, report.stopped, report.repeated) == (true, True, True)
        assert OVERFLOW in report.epochs
        assert not report.verdict.unknown
    assert not robot.moving
    assert robot.refuses()


@pytest.mark.usefixtures("one_halt")
def test_stops_with_fresh_ids_beyond_64_make_no_halt_no_report_and_no_record_each(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    first = filled(plane)
    stop(plane)
    eventually(lambda: len(robot.halts))
    before = len(robot.halts)
    for _ in range(2000):
        assert [each.stopped for each in stop(plane)] == [True]
    assert len(robot.halts) <= before + 1
    assert len(plane.robots["arm-1"].reports) == MAX_EPOCHS
    counted = eventually(lambda: [each for each in read_audit_log() if each["event"] == "estops_counted"])
    assert counted[0]["payload"]["some_sources"] == ["forger"]
    records = [each["payload"]["estop_id"] for each in read_audit_log() if each["event"] == "remote_estop_engaged"]
    assert records[0] == first
    assert len(records) <= MAX_EPOCHS + 1
    assert [each.stopped for each in stop(plane, "safety-1", first)] == [True], "the first one is still told apart"


def test_a_robot_that_is_locked_by_64_stops_is_still_halted_anew_by_later_ones(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plane_module, "HALT_AGAIN_S", 0.0)
    robot = add()
    filled(plane)
    stop(plane)
    before = eventually(lambda: len(robot.halts))
    run = plane.begin(StopOrder(new_epoch(), "safety-1"))
    assert run is not None
    assert run.wait(20)
    assert len(robot.halts) > before


@pytest.mark.usefixtures("one_halt")
def test_a_flood_is_never_answered_as_stopped_for_a_robot_that_did_not_stop(plane: SafetyPlane, add: Add) -> None:
    release = threading.Event()
    robot = add(before_halt=lambda: release.wait(60))
    for _ in range(MAX_EPOCHS + 2):
        stop(plane)
    assert [each.stopped for each in stop(plane)] == [None]
    release.set()
    eventually(lambda: [each.stopped for each in stop(plane)] == [True])
    assert robot.refuses()


@pytest.mark.usefixtures("one_halt")
def test_a_robot_cleared_at_its_machine_in_a_flood_is_locked_by_the_next_stop(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    filled(plane)
    stop(plane)
    plane.clear_local("ann")
    assert not robot.refuses()
    epoch = new_epoch()
    stop(plane, "safety-1", epoch)
    assert robot.refuses()
    assert plane.robots["arm-1"].epochs == (epoch,)


def test_count_names_some_sources_and_is_due_once_in_a_while() -> None:
    count = StopCount(10.0)
    assert count.take(0.0) is None
    for number in range(100):
        count.add(f"forger-{number:03}")
    facts = count.take(1.0)
    assert facts is not None
    assert (facts["stops"], len(facts["some_sources"])) == (100, SOURCES_NAMED)
    count.add("late")
    assert count.take(10.9) is None
    assert count.take(11.0) == {"stops": 1, "some_sources": ["late"]}
