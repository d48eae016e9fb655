"""Robot ids that another live process with the same state directory serves: a start is refused."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import replace

import pytest
from fixtures.moments import MomentClock

from strands_robots.safety import sighting_file, sightings
from strands_robots.safety.network_key import DEVICE_CONNECT, MESH, NetworkKey
from strands_robots.safety.sighting_file import Served, process_start
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
        store.refuse_taken(own, "arm-1")
    said = str(refusal.value)
    where = "the native mesh (127.0.0.1:7447)" if theirs is MESHED else "Device Connect (127.0.0.1:7447)"
    assert said.startswith(f"arm-1 is served already by process {os.getppid()} of this machine, on {where}.")
    assert "another peer_id" in said and "STRANDS_STATE_DIR" in said
    store.refuse_taken(own, "arm-2")


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
    store.refuse_taken(own, "arm-1")


def test_the_robot_of_a_process_that_ended_or_died_and_ones_own_are_not_refused(
    store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch, hasty: None
) -> None:
    row = served_by_another(store, clock)
    store.file.write([], [replace(row, ended=True), replace(row, started="an earlier process")], clock())
    store.refuse_taken(HERE, "arm-1")
    store.serve(HERE, "arm-1")
    store.refuse_taken(HERE, "arm-1")
    store.refuse_taken(MESHED, "arm-1")
    store.leave(HERE, "arm-1")
    # Where the system does not say when a process began, one that was killed is forgotten with its last writing.
    monkeypatch.setattr(sighting_file, "process_start", lambda pid: sighting_file.UNKNOWN)
    store.file.write([], [replace(row, started=sighting_file.UNKNOWN)], clock())
    with pytest.raises(DuplicateDeviceError):
        store.refuse_taken(HERE, "arm-1")
    clock.now = clock.now.earlier(-700.0)
    store.refuse_taken(HERE, "arm-1")


def test_a_start_waits_for_a_process_that_is_just_ending(store: Sightings, clock: MomentClock) -> None:
    row = served_by_another(store, clock)
    ending = threading.Timer(0.3, lambda: store.file.write([], [replace(row, ended=True)], clock()))
    ending.start()
    store.refuse_taken(HERE, "arm-1")
    ending.join()


def test_of_two_that_begin_at_once_the_later_one_is_refused(store: Sightings, clock: MomentClock, hasty: None) -> None:
    served_by_another(store, clock)
    store.serve(HERE, "arm-1")
    with pytest.raises(DuplicateDeviceError):
        store.refuse_taken(HERE, "arm-1")
    # It began anew, so it is the later one, though it was here before.
    store.leave(HERE, "arm-1")
    assert store.flush(5.0)
    store.serve(HERE, "arm-1")
    with pytest.raises(DuplicateDeviceError):
        store.refuse_taken(HERE, "arm-1")


def test_the_earlier_of_two_that_begin_at_once_goes_on(store: Sightings, clock: MomentClock, hasty: None) -> None:
    store.serve(HERE, "arm-1")
    assert store.flush(5.0)
    row = served_by_another(store, clock)
    store.refuse_taken(HERE, "arm-1")
    # The other one had served it before and begins again: it is the later one none the less.
    store.leave(HERE, "arm-1")
    store.file.write([], [replace(row, ended=True)], clock())
    store.serve(HERE, "arm-1")
    assert store.flush(5.0)
    store.file.write([], [row], clock())
    store.refuse_taken(HERE, "arm-1")


def test_a_disk_that_hangs_holds_a_start_up_for_a_second_and_refuses_nothing(
    store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    served_by_another(store, clock)
    hung = threading.Event()
    monkeypatch.setattr(store.file, "served", lambda: hung.wait(30.0) and [])
    began = time.monotonic()
    store.refuse_taken(HERE, "arm-1")
    assert time.monotonic() - began < 2.0
    hung.set()
