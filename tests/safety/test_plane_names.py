"""Robots that come, go and come again in one process, and robots of two names: none of it unlocks them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.planes import own_plane
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.safety import reporting
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.persistence import LockoutStore, StoredLockout, hardware_key
from strands_robots.safety.plane import SafetyPlane

KEY = hardware_key("so101", "usb-1")


@pytest.fixture
def robot() -> Iterator[RecordingRobot]:
    made = RecordingRobot()
    yield made
    made.close()


def stop(plane: SafetyPlane) -> str:
    epoch = new_epoch()
    plane.emergency_stop(StopOrder(epoch, "safety-1"))
    return epoch


def test_a_robot_of_two_names_is_locked_by_the_one_that_stays(plane: SafetyPlane, robot: RecordingRobot) -> None:
    plane.register("arm-1", robot)
    plane.register("lab.arm-1", robot).close()
    stop(plane)
    assert robot.refuses(), "the name that left took the latch of the other one with it"


def test_a_robot_of_two_names_moves_when_both_are_resumed(plane: SafetyPlane, robot: RecordingRobot) -> None:
    plane.register("arm-1", robot)
    plane.register("lab.arm-1", robot)
    stop(plane)
    plane.clear_local("ann", ["lab.arm-1"])
    assert robot.refuses()
    plane.clear_local("ann", ["arm-1"])
    assert not robot.refuses()


def test_the_lock_of_a_name_that_leaves_is_resumed_by_the_other(plane: SafetyPlane, robot: RecordingRobot) -> None:
    plane.register("arm-1", robot)
    other = plane.register("lab.arm-1", robot)
    plane.clear_local("ann", ["arm-1"])
    stop(plane)
    other.close()
    assert robot.refuses()
    plane.clear_local("ann", ["arm-1"])
    assert not robot.refuses()


def test_a_locked_robot_that_leaves_and_comes_again_is_still_locked(plane: SafetyPlane, robot: RecordingRobot) -> None:
    entry = plane.register("sim-1", robot)
    epoch = stop(plane)
    entry.close()
    assert robot.refuses(), "off the network it is locked as well"
    again = plane.register("sim-2", robot)
    assert again.epochs == (epoch,)
    # It is halted as it comes up locked, and what is asked for beside a halt is refused.
    eventually(lambda: robot.reasons[-1:] == ["it comes up locked"])
    plane.clear_local("ann")
    assert not robot.refuses()
    again.close()
    assert not plane.register("sim-1", robot).locked


def test_a_lock_that_no_disk_took_outlives_the_device_in_its_process(robot: RecordingRobot, tmp_path: Path) -> None:
    class Full(LockoutStore):
        def save(self, kept: Any) -> None:
            raise OSError(28, "No space left on device")

    with own_plane(20.0, Full(tmp_path)) as plane:
        entry = plane.register("arm-1", robot, key=KEY)
        stop(plane)
        entry.close()
        assert plane.register("arm-1", robot, key=KEY).locked


def test_what_an_operator_cleared_on_the_disk_meanwhile_stays_cleared(robot: RecordingRobot, tmp_path: Path) -> None:
    store = LockoutStore(tmp_path)
    with own_plane(20.0, store) as plane:
        entry = plane.register("arm-1", robot, key=KEY)
        stop(plane)
        entry.close()
        store.save({KEY: StoredLockout(seen=store.load(KEY).seen)})
        assert not plane.register("arm-1", robot, key=KEY).locked
        assert not robot.refuses()


def test_a_stop_whose_file_is_written_late_does_not_undo_what_was_cleared_meanwhile(
    robot: RecordingRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "GRACE_S", 60.0)
    store, halted = LockoutStore(tmp_path), threading.Event()
    with own_plane(20.0, store) as plane:
        entry = plane.register("arm-1", robot, key=KEY)
        plane.register("arm-2", RecordingRobot(before_halt=lambda: halted.wait(20)), key="slow")
        run = plane.begin(StopOrder(new_epoch(), "safety-1"))
        entry.close()
        assert store.load(KEY).state.locked
        store.save({KEY: StoredLockout(seen=store.load(KEY).seen)})
        halted.set()
        assert run is not None
        assert run.wait(20)
        assert store.load("slow").state.locked
        assert not store.load(KEY).state.locked


def test_a_robot_that_moves_while_it_comes_up_locked_is_halted(robot: RecordingRobot, tmp_path: Path) -> None:
    with own_plane(20.0, LockoutStore(tmp_path)) as plane:
        plane.register("arm-1", RecordingRobot(), key=KEY)
        stop(plane)
        plane.robots["arm-1"].close()
        robot.start()
        eventually(lambda: len(robot.device.times) > 3)
        plane.register("arm-1", robot, key=KEY)
        eventually(lambda: robot.halts)
        eventually(lambda: not robot.moving)
        written = len(robot.device.times)
        time.sleep(0.02)
        assert len(robot.device.times) == written
        assert robot.refuses()


def test_a_lock_that_a_second_network_gives_a_key_to_is_kept(robot: RecordingRobot, tmp_path: Path) -> None:
    store = LockoutStore(tmp_path)
    with own_plane(20.0, store) as plane:
        one = plane.register("arm-1", robot)
        epoch = stop(plane)
        plane.register("arm-1", robot, key=KEY)
        assert store.load(KEY).state.epochs == (epoch,)
        one.close()
