"""Epochs that a robot was resumed from are remembered, and never lock it again."""

from __future__ import annotations

import json
from pathlib import Path

from strands_robots.safety.lockout import RESUMED_MAX, LockoutLatch
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.persistence import LockoutStore, ResumedEpochs


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
