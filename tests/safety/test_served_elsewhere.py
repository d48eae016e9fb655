"""Robot ids that another live process with the same state directory serves: a start is refused."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.moments import MomentClock
from fixtures.waiting import eventually, said, signalled

from strands_robots.safety import sighting_file, sightings
from strands_robots.safety.network_key import DEVICE_CONNECT, MESH, NetworkKey
from strands_robots.safety.sighting_file import Served, SightingFileError, process_start
from strands_robots.safety.sightings import DuplicateDeviceError, Sightings

HERE = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
MESHED = NetworkKey.of(MESH, ["tcp/127.0.0.1:7447"])


def served_by_another(store: Sightings, clock: MomentClock, network: NetworkKey = MESHED) -> Served:
    """Write that the parent of this process serves arm-1."""
    row = Served(network, "arm-1", os.getppid(), process_start(os.getppid()), clock())
    store.file.write([], [row], clock())
    return row


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start waits for no process that may be ending."""
    monkeypatch.setattr(sightings, "LEAVES_S", 0.0)


@pytest.mark.parametrize(
    ("theirs", "own"),
    [
        pytest.param(MESHED, HERE, id="on Device Connect"),
        pytest.param(HERE, MESHED, id="on the mesh"),
        pytest.param(MESHED, MESHED, id="on one mesh"),
        pytest.param(MESHED, NetworkKey.of(MESH, ["tcp/desk:7447"]), id="on what may be the same mesh"),
    ],
)
def test_a_robot_id_that_another_live_process_serves_is_refused(
    store: Sightings, clock: MomentClock, theirs: NetworkKey, own: NetworkKey, hasty: None
) -> None:
    served_by_another(store, clock, theirs)
    with pytest.raises(DuplicateDeviceError) as refusal:
        store.was_here(own, "arm-1")
    said = str(refusal.value)
    where = "the native mesh (127.0.0.1:7447)" if theirs is MESHED else "Device Connect (127.0.0.1:7447)"
    assert said.startswith(f"arm-1 is served already by process {os.getppid()} of this machine, on {where}.")
    assert "another peer_id" in said and "STRANDS_STATE_DIR" in said
    store.was_here(own, "arm-2")


@pytest.mark.parametrize(
    ("theirs", "own"),
    [
        pytest.param(NetworkKey.of(DEVICE_CONNECT, HERE.where, "other"), MESHED, id="another tenant's"),
        pytest.param(NetworkKey.of(MESH, ["tcp/127.0.0.1:7448"]), MESHED, id="another mesh of this machine"),
        pytest.param(HERE, HERE, id="a device, which the network asks"),
    ],
)
def test_a_robot_that_callers_do_not_confuse_is_not_refused(
    store: Sightings, clock: MomentClock, theirs: NetworkKey, own: NetworkKey, hasty: None
) -> None:
    served_by_another(store, clock, theirs)
    store.was_here(own, "arm-1")


def test_the_robot_of_a_process_that_ended_or_died_and_ones_own_are_not_refused(
    store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch, hasty: None
) -> None:
    row = served_by_another(store, clock)
    store.file.write([], [replace(row, ended=True), replace(row, started="an earlier process")], clock())
    store.was_here(HERE, "arm-1")
    store.serve(HERE, "arm-1")
    store.was_here(HERE, "arm-1")
    store.was_here(MESHED, "arm-1")
    store.leave(HERE, "arm-1")
    # Where the system does not say when a process began, one that was killed is forgotten with its last writing.
    monkeypatch.setattr(sighting_file, "process_start", lambda pid: sighting_file.UNKNOWN)
    store.file.write([], [replace(row, started=sighting_file.UNKNOWN)], clock())
    with pytest.raises(DuplicateDeviceError):
        store.was_here(HERE, "arm-1")
    clock.now = clock.now.earlier(-700.0)
    store.was_here(HERE, "arm-1")


def test_a_start_waits_for_a_process_that_is_just_ending(store: Sightings, clock: MomentClock) -> None:
    row = served_by_another(store, clock)
    ending = threading.Timer(0.3, lambda: store.file.write([], [replace(row, ended=True)], clock()))
    ending.start()
    store.was_here(HERE, "arm-1")
    ending.join()


STARTING = """
import sys, time
from pathlib import Path
from strands_robots.safety import sightings
from strands_robots.safety.network_key import NetworkKey
sightings.BATCH_S = 600.0
store = sightings.Sightings(Path(sys.argv[1]))
store.serve(NetworkKey.parse(sys.argv[2]), "arm-1")
print("began", flush=True)
sys.stdin.readline()
print("written" if store.flush(5.0) else "not written", flush=True)
time.sleep(600)
"""


def test_of_two_that_begin_at_once_the_later_one_waits_for_the_row_of_the_first_and_is_refused(
    store: Sightings, child: Callable[..., subprocess.Popen[str]]
) -> None:
    first = child(STARTING, str(store.directory), MESHED.text)
    said(first, "began")
    assert store.was_here(HERE, "arm-1") is None
    writing = threading.Timer(0.3, lambda: print(file=first.stdin, flush=True))
    writing.start()
    with pytest.raises(DuplicateDeviceError, match=f"by process {first.pid} of this machine, on the native mesh"):
        store.serve(HERE, "arm-1")
    said(first, "written")


def test_a_process_that_began_since_the_first_look_is_seen(
    store: Sightings, child: Callable[..., subprocess.Popen[str]], hasty: None
) -> None:
    assert store.was_here(HERE, "arm-1") is None
    first = child(STARTING, str(store.directory), MESHED.text)
    said(first, "began")
    print(file=first.stdin, flush=True)
    said(first, "written")
    for _ in range(2):
        with pytest.raises(DuplicateDeviceError, match="on the native mesh"):
            store.serve(HERE, "arm-1")


def test_a_start_reads_the_disk_once_where_nobody_began_meanwhile(
    store: Sightings, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[str] = []
    read = store.file.served
    monkeypatch.setattr(store.file, "served", lambda name: looks.append(name) or read(name))
    for name in ("arm-1", "arm-2", "arm-1"):
        store.was_here(HERE, name)
        store.serve(HERE, name)
        assert store.flush(5.0)
    assert looks == ["arm-1", "arm-2", "arm-1"]
    store.serve(HERE, "arm-3")
    assert looks[-1] == "arm-3"


def test_a_start_is_refused_while_a_frozen_process_begins_and_not_once_it_is_killed(
    store: Sightings, child: Callable[..., subprocess.Popen[str]], hasty: None
) -> None:
    first = child(STARTING, str(store.directory), MESHED.text)
    said(first, "began")
    signalled(first, signal.SIGSTOP)
    for _ in range(2):
        with pytest.raises(DuplicateDeviceError, match="another process of this machine, which is just starting it"):
            store.serve(HERE, "arm-1")
    # Robots of other names and tenants do not wait for it.
    store.serve(HERE, "arm-2")
    store.serve(NetworkKey.of(DEVICE_CONNECT, HERE.where, "other"), "arm-1")
    first.kill()
    first.wait()
    store.serve(HERE, "arm-1")
    store.serve(MESHED, "arm-1")
    assert store.flush(5.0)


def test_a_start_keeps_no_descriptor_once_it_is_written(store: Sightings) -> None:
    for _ in range(2):
        store.was_here(HERE, "arm-1")
        store.serve(HERE, "arm-1")
        store.serve(MESHED, "arm-1")
        assert store.flush(5.0)
        assert store.directory / "starting.lock" not in _open_files()
        store.leave(HERE, "arm-1")
        store.leave(MESHED, "arm-1")


def _open_files() -> list[Path]:
    files = []
    for each in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            files.append(each.readlink())
    return files


def test_a_start_holds_its_lock_until_its_row_is_written_or_given_up(
    store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sightings, "RETRY_S", 0.01)
    lock, busy = store.directory / "starting.lock", threading.Event()
    write = store.file.write

    def refuse(*rows: Any, **facts: Any) -> None:
        if busy.is_set():
            raise SightingFileError("the file is busy")
        write(*rows, **facts)

    monkeypatch.setattr(store.file, "write", refuse)
    busy.set()
    store.serve(HERE, "arm-1")
    assert not store.flush(5.0)
    assert lock in _open_files()
    busy.clear()
    assert store.flush(5.0)
    assert lock not in _open_files()
    busy.set()
    store.serve(HERE, "arm-2")
    eventually(lambda: lock not in _open_files())


def test_a_file_that_cannot_be_locked_refuses_no_start(store: Sightings, caplog: pytest.LogCaptureFixture) -> None:
    store.directory.mkdir(mode=0o700)
    (store.directory / "starting.lock").mkdir()
    store.serve(HERE, "arm-1")
    assert "arm-1: it is not known whether another process serves it" in caplog.text
    assert store.flush(5.0)
    assert store.was_here(MESHED, "arm-1") is None


def test_a_disk_that_hangs_holds_a_start_up_for_a_second_and_refuses_nothing(
    store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    served_by_another(store, clock)
    hung = threading.Event()
    monkeypatch.setattr(store.file, "served", lambda name: hung.wait(30.0) and [])
    began = time.monotonic()
    store.was_here(HERE, "arm-1")
    assert time.monotonic() - began < 2.0
    hung.set()
