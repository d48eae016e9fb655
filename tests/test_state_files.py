"""State files of another user, open to others, or of another time: none of them frees or moves a robot."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest
from fixtures.waiting import eventually

from strands_robots import state_files
from strands_robots.safety import authorization, resume
from strands_robots.safety.authorization import Grants
from strands_robots.safety.lockout import OVERFLOW, Lockout, LockoutState
from strands_robots.safety.persistence import LockoutStore, StoredLockout
from strands_robots.state_files import StateFileError, adopt, read_private, uptime

KEY = "hardware:so100:/dev/ttyACM0"
FREE = StoredLockout(name="arm-1")
LOCKED = StoredLockout(LockoutState((Lockout("a" * 32, "safety-1", "smoke", 1.0),)), name="arm-1")


@pytest.fixture
def store(state_directory: Path) -> LockoutStore:
    return LockoutStore(state_directory)


@pytest.fixture
def grants(state_directory: Path) -> Grants:
    return Grants(state_directory / "grants")


def open_the_state_directory(store: LockoutStore) -> None:
    store.root.chmod(0o777)


def open_the_folder(store: LockoutStore) -> None:
    store.directory.chmod(0o777)


def open_the_file(store: LockoutStore) -> None:
    store.file(KEY).chmod(0o666)


@pytest.mark.parametrize("loosen", [open_the_state_directory, open_the_folder, open_the_file])
@pytest.mark.parametrize("kept", [FREE, LOCKED], ids=["free", "locked"])
def test_lockout_that_others_may_write_keeps_the_robot_locked_and_is_named(
    store: LockoutStore, loosen: object, kept: StoredLockout, caplog: pytest.LogCaptureFixture
) -> None:
    store.save({KEY: kept})
    assert callable(loosen)
    loosen(store)
    state = store.load(KEY).state
    assert state.epochs == (OVERFLOW,)
    assert "not this user's alone" in state.all[0].reason
    assert "others may" in caplog.text and "chmod" in caplog.text
    with pytest.raises(StateFileError, match="others may"):
        store.load_all()


def test_lockout_that_was_deleted_from_an_open_folder_locks_too(store: LockoutStore) -> None:
    store.save({KEY: LOCKED, "other": FREE})
    open_the_folder(store)
    store.file(KEY).unlink()
    assert store.load(KEY).state.epochs == (OVERFLOW,)


def test_lockout_of_another_user_keeps_the_robot_locked_and_is_named(
    store: LockoutStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store.save({KEY: FREE})
    monkeypatch.setattr(os, "getuid", lambda: 4711)
    assert store.load(KEY).state.epochs == (OVERFLOW,)
    assert "belongs to uid" in caplog.text


@pytest.mark.parametrize("what", ["state directory", "folder", "file"])
def test_grant_that_others_may_write_is_void_and_named(
    grants: Grants, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = grants.grant("execute", "arm-1")
    open_one = {"state directory": path.parent.parent, "folder": path.parent, "file": path}[what]
    open_one.chmod(0o777)
    assert grants.claim("execute", "arm-1") is None
    assert "is void" in caplog.text and "others may" in caplog.text


def test_grant_of_another_user_is_void_and_named(
    grants: Grants, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    grants.grant("execute", "arm-1")
    monkeypatch.setattr(os, "getuid", lambda: 4711)
    assert grants.claim("execute", "arm-1") is None
    assert "belongs to uid" in caplog.text


def test_grant_is_not_issued_into_a_folder_that_others_may_write(grants: Grants) -> None:
    grants.grant("execute", "arm-1")
    grants.folder.chmod(0o777)
    with pytest.raises(StateFileError, match="others may write there"):
        grants.grant("execute", "arm-1")


def test_expired_grant_stays_expired_when_the_wall_clock_is_set_back(
    grants: Grants, monkeypatch: pytest.MonkeyPatch
) -> None:
    grants.grant("execute", "arm-1", 0.05)
    end = uptime() + 0.06
    eventually(lambda: uptime() > end)
    wall = time.time
    monkeypatch.setattr(time, "time", lambda: wall() - 3600)
    assert grants.claim("execute", "arm-1") is None


def test_grant_of_an_earlier_boot_is_void(grants: Grants, monkeypatch: pytest.MonkeyPatch) -> None:
    grants.grant("execute", "arm-1")
    monkeypatch.setattr(authorization, "boot", lambda: "another boot")
    assert grants.claim("execute", "arm-1") is None


def test_clearance_that_others_may_write_is_not_taken(state_directory: Path) -> None:
    cleared: list[str] = []
    inbox = resume.ClearanceInbox(lambda: {"arm-1"}, lambda who, robot_id: cleared.append(robot_id) or "cleared")
    (order,) = resume.order_clearance("ann", ["arm-1"])
    order.chmod(0o666)
    inbox.look(0)
    state_directory.chmod(0o777)
    order.chmod(0o600)
    inbox.look(0)
    assert cleared == []
    state_directory.chmod(0o700)
    inbox.look(0)
    assert cleared == ["arm-1"]


def test_clearance_of_an_earlier_boot_is_void(state_directory: Path) -> None:
    cleared: list[str] = []
    inbox = resume.ClearanceInbox(lambda: {"arm-1"}, lambda who, robot_id: cleared.append(robot_id) or "cleared")
    (path,) = resume.order_clearance("ann", ["arm-1"])
    path.write_text(json.dumps({**json.loads(path.read_text()), "boot": "another"}))
    inbox.look(0)
    assert cleared == []


def test_empty_state_directory_that_the_user_left_open_is_closed_and_used(tmp_path: Path) -> None:
    root = tmp_path / "made-by-hand"
    root.mkdir()
    root.chmod(0o775)
    store = LockoutStore(root)
    assert not store.load(KEY).state.locked
    assert root.stat().st_mode & 0o777 == 0o700


def test_shared_directory_is_not_closed(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    adopt(shared)
    assert shared.stat().st_mode & 0o7777 == 0o1777
    assert LockoutStore(shared).load(KEY).state.epochs == (OVERFLOW,)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.mkdir(), lambda path: path.symlink_to("/etc/hostname")])
def test_what_is_no_plain_file_is_refused_without_waiting(tmp_path: Path, make: object) -> None:
    path = tmp_path / "state.json"
    assert callable(make)
    make(path)
    with pytest.raises((StateFileError, OSError)):
        read_private(path, tmp_path)


def test_age_counts_where_there_is_no_id_of_the_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_files, "_BOOT_ID", Path("/nonexistent"))
    assert state_files.boot() == ""
    monkeypatch.delattr(time, "CLOCK_BOOTTIME")
    assert uptime() > 0
