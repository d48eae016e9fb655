"""Lockouts that outlive the process."""

from __future__ import annotations

import fcntl
import json
import stat
import threading
from pathlib import Path

import pytest

from strands_robots.safety import persistence
from strands_robots.safety.lockout import OVERFLOW, Lockout, LockoutState
from strands_robots.safety.persistence import LockoutStore, StoredLockout, hardware_key, simulation_key

LOCKOUT = Lockout("a" * 32, "safety-1", "smoke \N{FIRE}", 12.5)
KEY = hardware_key("so101", "usb-FTDI-1234")


@pytest.fixture
def store(tmp_path: Path) -> LockoutStore:
    return LockoutStore(tmp_path / "state")


def test_a_lockout_comes_back_whole(store: LockoutStore) -> None:
    kept = StoredLockout(LockoutState((LOCKOUT,), Lockout(OVERFLOW, "s", "", 1.0)), ("b" * 32, "a" * 32))
    store.save({KEY: kept})
    assert store.load(KEY) == kept
    assert store.load_all() == {KEY: kept}
    assert stat.S_IMODE(store.path.stat().st_mode) == 0o600


def test_a_robot_that_was_never_kept_is_free(store: LockoutStore) -> None:
    assert store.load(simulation_key("sim-1")) == StoredLockout()


def test_saving_one_robot_leaves_the_others(store: LockoutStore) -> None:
    store.save({KEY: StoredLockout(LockoutState((LOCKOUT,)))})
    store.save({"other": StoredLockout()})
    assert store.load(KEY).state.locked


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        '{"v":2,"robots":{}}',
        json.dumps({"v": 1, "robots": {KEY: {"holds": []}}}),
        json.dumps({"v": 1, "robots": {KEY: {"holds": [{"epoch": 1}], "overflow": None, "seen": []}}}),
        json.dumps({"v": 1, "robots": {KEY: 7}}),
    ],
)
def test_what_cannot_be_read_locks_until_somebody_at_the_machine_looks(
    store: LockoutStore, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    store.path.parent.mkdir()
    store.path.write_text(content)
    state = store.load(KEY).state
    assert state.locked
    assert state.epochs == (OVERFLOW,)
    assert "comes up locked" in caplog.text


def test_an_unreadable_file_is_put_aside_when_the_next_lockout_is_kept(store: LockoutStore) -> None:
    store.path.parent.mkdir()
    store.path.write_text("{")
    store.save({KEY: StoredLockout(LockoutState((LOCKOUT,)))})
    assert store.load(KEY).state.epochs == (LOCKOUT.epoch,)
    assert store.path.with_suffix(".unreadable").read_text() == "{"


def test_a_robot_that_was_off_while_the_file_was_put_aside_comes_up_locked(store: LockoutStore) -> None:
    store.path.parent.mkdir()
    store.path.write_text('{"v":1,"robots":{"the other": {"holds": [')
    store.save({KEY: StoredLockout()})
    assert store.load("the other").state.epochs == (OVERFLOW,)
    assert not store.load(KEY).state.locked
    store.save({"the other": StoredLockout()})
    assert not store.load("the other").state.locked, "an operator has cleared it"


def test_a_link_in_place_of_the_file_locks(store: LockoutStore, tmp_path: Path) -> None:
    store.path.parent.mkdir()
    (tmp_path / "free").write_text('{"v":1,"robots":{}}')
    store.path.symlink_to(tmp_path / "free")
    assert store.load(KEY).state.locked


def test_a_file_that_another_process_holds_is_an_error_in_time_and_not_a_wait(store: LockoutStore) -> None:
    store.save({})
    with store.path.with_name("lockouts.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(TimeoutError):
            store.save({KEY: StoredLockout()})
    store.save({KEY: StoredLockout()})


def test_writers_at_once_lose_no_record(store: LockoutStore, monkeypatch: pytest.MonkeyPatch) -> None:
    # Each waits for all before it, each of which waits for the disk.
    monkeypatch.setattr(persistence, "LOCK_WAIT_S", 60.0)
    threads = [
        threading.Thread(target=lambda n=n: store.save({f"robot-{n}": StoredLockout(LockoutState((LOCKOUT,)))}))
        for n in range(12)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(store.load_all()) == 12
