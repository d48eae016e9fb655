"""Lockouts that outlive the process."""

from __future__ import annotations

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
    assert stat.S_IMODE(store.file(KEY).stat().st_mode) == 0o600
    assert stat.S_IMODE(store.directory.stat().st_mode) == stat.S_IMODE(store.directory.parent.stat().st_mode) == 0o700


def test_a_robot_that_was_never_kept_is_free(store: LockoutStore) -> None:
    assert store.load(simulation_key("sim-1")) == StoredLockout()


def test_saving_one_robot_leaves_the_others(store: LockoutStore) -> None:
    store.save({KEY: StoredLockout(LockoutState((LOCKOUT,)))})
    store.save({"other": StoredLockout()})
    assert store.load(KEY).state.locked


def record(content: str, key: str = KEY) -> str:
    """A file of one robot with these fields."""
    return f'{{"v":2,"key":{json.dumps(key)},{content}}}'


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        '{"v":3}',
        '{"v":2}',
        record('"holds":[]'),
        record('"holds":[{"epoch":1}],"overflow":null,"seen":[]'),
        record('"holds":7,"overflow":null,"seen":[]'),
        record('"holds":[],"overflow":null,"seen":[]', key="another"),
    ],
)
def test_what_cannot_be_read_locks_until_somebody_at_the_machine_looks(
    store: LockoutStore, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    store.save({"other": StoredLockout()})
    store.file(KEY).write_text(content)
    state = store.load(KEY).state
    assert state.locked
    assert state.epochs == (OVERFLOW,)
    assert "comes up locked" in caplog.text
    assert not store.load("other").state.locked, "each robot has a file of its own"


def test_an_unreadable_file_is_replaced_by_the_next_lockout_that_is_kept(store: LockoutStore) -> None:
    store.save({})
    store.file(KEY).write_text("{")
    store.save({KEY: StoredLockout(LockoutState((LOCKOUT,)))})
    assert store.load(KEY).state.epochs == (LOCKOUT.epoch,)


def of_all(store: LockoutStore, robots: object) -> Path:
    """Write the one file in which an earlier release kept all robots."""
    store.save({})
    store.file_of_all.write_text(json.dumps({"v": 1, "robots": robots}))
    return store.file_of_all


def test_lockouts_of_an_earlier_release_are_respected_and_its_clearing_too(store: LockoutStore) -> None:
    hold = {"epoch": LOCKOUT.epoch, "source": "safety-1", "reason": "smoke", "at": 12.5}
    of_all(store, {KEY: {"name": "arm-1", "holds": [hold], "overflow": None, "seen": [LOCKOUT.epoch]}})
    kept = store.load(KEY)
    assert (kept.state.epochs, kept.seen, kept.name) == ((LOCKOUT.epoch,), (LOCKOUT.epoch,), "arm-1")
    assert store.load_all() == {KEY: kept}
    assert not store.load("other").state.locked
    store.save({KEY: StoredLockout(name="arm-1")})
    assert not store.load(KEY).state.locked
    assert not store.load_all()[KEY].state.locked


@pytest.mark.parametrize("robots", [7, {KEY: 7}, {KEY: {"holds": []}}])
def test_an_unreadable_file_of_an_earlier_release_locks_its_robots(store: LockoutStore, robots: object) -> None:
    of_all(store, robots)
    assert store.load(KEY).state.epochs == (OVERFLOW,)
    with pytest.raises(ValueError, match="record of lockouts"):
        store.load_all()
    store.save({KEY: StoredLockout()})
    assert not store.load(KEY).state.locked, "an operator has cleared it"


def test_an_unreadable_file_of_an_earlier_release_is_put_aside_when_the_next_lockout_is_kept(
    store: LockoutStore,
) -> None:
    of_all(store, 7).write_text("{")
    store.save({KEY: StoredLockout(LockoutState((LOCKOUT,)))})
    assert store.load(KEY).state.epochs == (LOCKOUT.epoch,)
    assert store.load_all().keys() == {KEY}
    assert store.file_of_all.with_suffix(".unreadable").read_text() == "{"
    assert store.load("the other").state.epochs == (OVERFLOW,)


def test_a_robot_that_was_off_while_the_file_was_put_aside_comes_up_locked(store: LockoutStore) -> None:
    store.save({KEY: StoredLockout()})
    aside = store.file_of_all.with_suffix(".unreadable")
    aside.write_text('{"v":1,"robots":{"the other": {"holds": [')
    assert store.load("the other").state.epochs == (OVERFLOW,)
    assert not store.load(KEY).state.locked
    store.save({"the other": StoredLockout()})
    assert not store.load("the other").state.locked, "an operator has cleared it"


def test_a_link_in_place_of_the_file_locks(store: LockoutStore, tmp_path: Path) -> None:
    store.save({})
    (tmp_path / "free").write_text(record('"holds":[],"overflow":null,"seen":[]'))
    store.file(KEY).symlink_to(tmp_path / "free")
    assert store.load(KEY).state.locked


def test_keys_that_look_alike_in_a_file_name_are_kept_apart(store: LockoutStore) -> None:
    store.save({"a:b": StoredLockout(LockoutState((LOCKOUT,))), "a/b": StoredLockout()})
    assert store.load("a:b").state.locked
    assert not store.load("a/b").state.locked
    assert set(store.load_all()) == {"a:b", "a/b"}


def test_save_that_fails_keeps_what_was_there_and_leaves_no_draft(
    store: LockoutStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.save({KEY: StoredLockout(LockoutState((LOCKOUT,)))})

    def full(descriptor: int, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(persistence.os, "write", full)
        with pytest.raises(OSError, match="No space"):
            store.save({KEY: StoredLockout(), "other": StoredLockout()})
    assert [path.name for path in store.directory.iterdir()] == [store.file(KEY).name]
    assert store.load(KEY).state.locked


def test_writers_at_once_lose_no_record_and_wait_for_no_other(store: LockoutStore) -> None:
    threads = [
        threading.Thread(target=lambda n=n: store.save({f"robot-{n}": StoredLockout(LockoutState((LOCKOUT,)))}))
        for n in range(12)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(store.load_all()) == 12
