"""Robots that have no sign since the stop from which others are freed."""

from __future__ import annotations

import os
import time

import pytest

from strands_robots.safety.lockout import Lockout, LockoutState
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.persistence import StoredLockout
from strands_robots.safety.roster import Roster
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.sighting_file import Note, Served, process_start
from strands_robots.safety.sightings import sightings, this_moment
from strands_robots.safety.stop_notes import unheard_now, unheard_since

NETWORK = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
ELSEWHERE = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7448"])
EPOCH = "a" * 32
PRESSED_AGO_S = 60.0


def heard(name: str, ago: float, network: NetworkKey = NETWORK, cell: str = "") -> None:
    note = Note(network, name, this_moment().earlier(ago), None, cell, None, True, False)
    sightings().file.write([note], [], this_moment())


def serve(name: str) -> None:
    """Have a living process serve a robot since before the stop."""
    since = this_moment().earlier(2 * PRESSED_AGO_S)
    row = Served(NETWORK, name, os.getpid(), process_start(os.getpid()), since)
    sightings().file.write([], [row], this_moment())


def locked(name: str = "arm-1", scope: Scope = EVERY_ROBOT) -> dict[str, StoredLockout]:
    lockout = Lockout(EPOCH, "desk", "", time.time() - PRESSED_AGO_S, scope)
    return {f"simulation:{name}": StoredLockout(LockoutState((lockout,)), name=name)}


@pytest.mark.parametrize(("ago", "names"), [(2 * PRESSED_AGO_S, ("arm-2",)), (1.0, ())])
def test_robot_of_another_machine_has_to_be_heard_since_the_stop(ago: float, names: tuple[str, ...]) -> None:
    serve("arm-1")
    heard("arm-2", ago)
    assert unheard_since(["arm-1"], locked()).names == names


def test_robot_of_this_machine_has_to_have_acted_on_the_stop() -> None:
    serve("arm-1")
    serve("arm-2")
    assert unheard_since(["arm-1"], locked()).names == ("arm-2",)
    resumed = {"simulation:arm-2": StoredLockout(seen=(EPOCH,), name="arm-2")}
    assert not unheard_since(["arm-1"], locked() | resumed)


def test_every_record_of_a_name_counts() -> None:
    serve("arm-1")
    serve("arm-2")
    twice = {
        "hardware:arm:arm-2": StoredLockout(seen=(EPOCH,), name="arm-2"),
        "simulation:arm-2": StoredLockout(name="arm-2"),
    }
    assert not unheard_since(["arm-1"], locked() | twice)


def test_robots_that_the_stop_was_not_for_are_not_named() -> None:
    serve("arm-1")
    heard("far-1", 2 * PRESSED_AGO_S, ELSEWHERE)
    heard("other-cell", 2 * PRESSED_AGO_S, cell="cell-2")
    heard("same-cell", 2 * PRESSED_AGO_S, cell="cell-1")
    assert unheard_since(["arm-1"], locked(scope=Scope(cell="cell-1"))).names == ("same-cell",)


def test_nothing_is_named_where_no_robot_is_freed_from_a_stop() -> None:
    serve("arm-1")
    heard("arm-2", 2 * PRESSED_AGO_S)
    assert not unheard_since(["arm-9"], locked())
    assert not unheard_since(["arm-1"], {})


def test_robots_that_do_not_answer_now_are_named() -> None:
    serve("arm-1")
    heard("arm-2", 1.0)
    found = unheard_now(NETWORK, ["arm-1"])
    assert found.names == ("arm-2",)
    assert "NOT HEARD: arm-2." in str(found)


def test_roster_that_cannot_be_read_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    serve("arm-1")

    def broken(*_arguments: object) -> Roster:
        raise OSError("the disk is gone")

    monkeypatch.setattr(Roster, "of", broken)
    for found in (unheard_now(NETWORK, []), unheard_since(["arm-1"], locked())):
        assert found and "the disk is gone" in str(found)
