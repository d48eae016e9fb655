"""Epochs that a robot was resumed from are remembered, and never lock it again."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.safety import lockout
from strands_robots.safety import plane as plane_module
from strands_robots.safety.lockout import (
    LONG_AGO,
    MAX_EPOCHS,
    OVERFLOW,
    RESUMED_MAX,
    Lockout,
    LockoutLatch,
    LockoutState,
)
from strands_robots.safety.orders import MISSED, StopOrder, new_epoch
from strands_robots.safety.persistence import LockoutStore, ResumedEpochs, StoredLockout
from strands_robots.safety.plane import SafetyPlane
from strands_robots.state_files import uptime

Add = Callable[..., RecordingRobot]


def test_epochs_that_an_overflow_stood_for_count_as_resumed_once_it_was_cleared() -> None:
    latch = LockoutLatch("arm-1")
    epochs = [new_epoch() for _ in range(100)]
    for each in epochs:
        latch.engage(each, "safety-1", "")
    latch.clear()
    assert set(epochs) <= set(latch.resumed)
    assert not any(latch.engage(each, "safety-1", "") for each in epochs)


def test_stops_cannot_evict_a_resumed_epoch_and_resumes_evict_the_oldest() -> None:
    latch = LockoutLatch("arm-1")
    first = new_epoch()
    latch.engage(first, "safety-1", "")
    latch.resume(first)
    for _ in range(2000):
        latch.engage(new_epoch(), "stranger", "")
    assert not latch.engage(first, "safety-1", "")
    latch.forgo(new_epoch() for _ in range(RESUMED_MAX))
    assert len(latch.resumed) == RESUMED_MAX
    assert first not in latch.resumed


def test_lockout_file_of_yesterday_loads_and_its_robot_has_no_original(tmp_path: Path) -> None:
    store = LockoutStore(tmp_path)
    store.save({})
    epoch = new_epoch()
    hold = {"epoch": epoch, "source": "safety-1", "reason": "", "at": 1.0}
    record = {"v": 2, "key": "k", "name": "arm-1", "holds": [hold], "overflow": None, "seen": [epoch]}
    store.file("k").write_text(json.dumps(record))
    kept = store.load("k")
    assert kept.state.epochs == (epoch,)
    assert (kept.originals, kept.resumed) == ((), None)


def test_unreadable_record_of_resumed_epochs_locks_as_an_unreadable_lockout_does(tmp_path: Path) -> None:
    store = LockoutStore(tmp_path)
    store.save_resumed({"k": ResumedEpochs({new_epoch(): None})})
    store.resumed_file("k").write_text("{")
    assert store.load("k").state.locked


def flood(plane: SafetyPlane) -> None:
    """Lock every robot by more stops than it tells apart."""
    for _ in range(MAX_EPOCHS + 1):
        plane.begin(StopOrder(new_epoch(), "forger"))


def missed(epoch: str) -> StopOrder:
    """A stop that somebody else received at this moment."""
    return StopOrder(epoch, "desk", path=MISSED)


@pytest.mark.parametrize("halt_again_s", [0.0, 3600.0], ids=["each halts", "one halt answers"])
def test_stop_that_was_missed_after_a_flood_locks_once_the_flood_was_cleared(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch, halt_again_s: float
) -> None:
    monkeypatch.setattr(lockout, "SKEW_S", 0.0)
    monkeypatch.setattr(plane_module, "HALT_AGAIN_S", halt_again_s)
    add()
    flood(plane)
    within = missed(new_epoch())
    time.sleep(0.01)
    # The last ones that it received.
    plane.begin(StopOrder(new_epoch(), "forger"))
    plane.begin(StopOrder(new_epoch(), "forger"))
    time.sleep(0.01)
    afterwards = missed(new_epoch())
    time.sleep(0.01)
    plane.clear_local("the operator")
    plane.begin(within)
    assert plane.robots["arm-1"].epochs == ()
    plane.begin(afterwards)
    assert plane.robots["arm-1"].epochs == (afterwards.epoch,)


def test_times_of_a_flood_are_kept_and_those_of_yesterday_have_no_end(tmp_path: Path) -> None:
    store, since = LockoutStore(tmp_path), uptime() - 60.0
    state = LockoutState(overflow=Lockout(OVERFLOW, "forger"))
    store.save({"k": StoredLockout(state, crowd=(since, since + 1.0))})
    kept = store.load("k")
    assert kept.crowd == (since, since + 1.0)
    freed = kept.freed()
    assert freed.resumed is not None and freed.resumed.cleared == ((since, since + 1.0),)
    record = json.loads(store.file("k").read_text())
    del record["crowded_until"]
    store.file("k").write_text(json.dumps(record))
    assert store.load("k").crowd == (since, math.inf)
    assert LockoutLatch("arm-1", state, crowd=store.load("k").crowd).crowd[1] <= uptime()


def test_end_of_a_flood_reaches_the_disk(plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plane_module, "HALT_AGAIN_S", 3600.0)
    add(key="k")
    flood(plane)
    eventually(lambda: plane.store.load("k").state.overflow is not None)
    plane.begin(StopOrder(new_epoch(), "forger"))
    eventually(lambda: plane.store.load("k").crowd == plane.robots["arm-1"].latch.crowd)


def test_times_of_a_flood_are_inherited_with_it(plane: SafetyPlane) -> None:
    since = uptime() - 60.0
    state = LockoutState(overflow=Lockout(OVERFLOW, "forger"))
    plane.store.save({"k": StoredLockout(state, crowd=(since, since + 1.0))})
    robot = RecordingRobot()
    entry = plane.register("arm-1", robot)
    plane.register("arm-1", robot, key="k")
    assert entry.latch.crowd == (since, since + 1.0)
    heir = LockoutLatch("arm-1")
    heir.inherit(state, (LONG_AGO, since))
    heir.inherit(state, (since, since + 2.0))
    assert heir.crowd == (LONG_AGO, since + 2.0)
    robot.close()
