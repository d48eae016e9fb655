"""Tries to make the sentence false: exit code 0, every robot in the roster is known to stand still."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.roster_lab import Kind, RosterLab
from fixtures.roster_robots import RosterRobots
from fixtures.waiting import eventually

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

STOP = ("estop", "--deadline", "2")
GHOSTS = 2000


@pytest.fixture(params=["nats"])
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RosterLab]:
    kind: Kind = request.param
    with ExitStack() as stack:
        yield RosterLab(kind, tmp_path, stack)


@pytest.fixture(params=["robots", "enrolled"])
def console(request: pytest.FixtureRequest, lab: RosterLab) -> Machine:
    """A console of the robots' own machine, one that has heard them, and one that has enrolled them."""
    return known_by(request.param, lab)


def known_by(how: str, lab: RosterLab) -> Machine:
    witness, absent = lab.robots("arm-0", first=True), lab.robots("arm-1")
    made = lab.console("robots" if how == "robots" else "console")
    if how == "enrolled":
        eventually(lambda: made.run("enroll", "arm-0", "arm-1", *lab.flags).returncode == 0, 60)
    lab.meet(made, "arm-0", "arm-1")
    lab.served = {"arm-0": witness, "arm-1": absent}  # type: ignore[attr-defined]
    return made


def robot(lab: RosterLab, name: str = "arm-1") -> RosterRobots:
    found: RosterRobots = lab.served[name]  # type: ignore[attr-defined]
    return found


def red(console: Machine, lab: RosterLab, name: str = "arm-1", *more: str) -> None:
    """The stop is not green, and names the robot."""
    said = console.run(*STOP, *more, *lab.flags)
    assert said.returncode != 0, said.stdout + said.stderr
    assert name in said.stdout + said.stderr


@pytest.mark.parametrize("how", ["robots", "enrolled"])
def test_stranger_says_stopped_for_a_frozen_robot(lab: RosterLab, how: str) -> None:
    """A machine that has neither served nor enrolled the robot knows no key to check its answer with."""
    console, stranger = known_by(how, lab), lab.stranger()
    robot(lab).freeze()
    stranger.ask("claim", "arm-1")
    red(console, lab)


def test_stranger_plays_the_verdict_of_an_earlier_stop_again(console: Machine, lab: RosterLab) -> None:
    stranger = lab.stranger()
    eventually(lambda: console.run(*STOP, *lab.flags).returncode == 0, 60)
    for each in ("arm-0", "arm-1"):
        robot(lab, each).ask("clear")
    robot(lab).freeze()
    assert stranger.ask("replay", "arm-1") > 0
    red(console, lab)


@pytest.mark.parametrize("kind", ["departing", "no stop", "both"])
def test_stranger_says_that_a_frozen_robot_left_or_cannot_stop(console: Machine, lab: RosterLab, kind: str) -> None:
    stranger = lab.stranger()
    robot(lab).freeze()
    stranger.ask("present", "arm-1", kind != "no stop", kind != "departing")
    hear(console, lab)
    stranger.ask("keep_present", "arm-1", kind != "no stop", kind != "departing", 8.0)
    red(console, lab)


def test_stranger_puts_a_frozen_robot_into_another_cell(console: Machine, lab: RosterLab) -> None:
    stranger = lab.stranger()
    robot(lab).freeze()
    stranger.ask("present", "arm-1", False, False, "cell-2")
    hear(console, lab)
    stranger.ask("keep_present", "arm-1", False, False, 8.0, "cell-2")
    red(console, lab, "arm-1", "--cell", "cell-1")


def test_thousands_of_made_up_names_hide_no_frozen_robot(console: Machine, lab: RosterLab) -> None:
    stranger = lab.stranger()
    robot(lab).freeze()
    for _ in range(3):
        stranger.ask("names", GHOSTS)
        hear(console, lab)
    stranger.ask("keep_announcing", GHOSTS, 10.0, "aaa")
    red(console, lab)


def test_second_process_of_the_same_name_answers_for_a_frozen_one(lab: RosterLab) -> None:
    """Their own machine knows of both; for another one they are the same robot."""
    console, first = known_by("robots", lab), robot(lab)
    first.freeze()
    # Of a name that answers it is refused.
    second = lab.robots("arm-1", state="robots")
    missed(console, lab)
    first.wake()
    eventually(lambda: console.run(*STOP, *lab.flags).returncode == 0, 60)
    assert "is served by the processes" in console.run(*STOP, *lab.flags).stdout
    second.freeze()
    missed(console, lab)


def missed(console: Machine, lab: RosterLab) -> None:
    """The stop names a process of arm-1 that gave no answer."""
    said = json.loads(console.run(*STOP, "--json", *lab.flags).stdout)
    assert said["silent"] == ["arm-1"], said
    assert said["reasons"]["arm-1"].endswith("gives no answer; another process of that name did")


def test_robot_killed_and_served_under_another_name(console: Machine, lab: RosterLab) -> None:
    robot(lab).kill()
    lab.robots("arm-9")
    red(console, lab)


def test_short_deadline(console: Machine, lab: RosterLab) -> None:
    robot(lab).freeze()
    said = console.run("estop", "--deadline", "0.1", *lab.flags)
    assert said.returncode != 0, said.stdout + said.stderr


def test_stop_of_named_robots_counts_the_others_as_well(console: Machine, lab: RosterLab) -> None:
    robot(lab).freeze()
    red(console, lab, "arm-1", "arm-0")


@pytest.mark.parametrize("after_s", [0.4, 1.2])
def test_interrupted_stop_is_not_green(console: Machine, lab: RosterLab, after_s: float) -> None:
    robot(lab).freeze()
    running = console.start("estop", "--deadline", "10", *lab.flags)
    time.sleep(after_s)
    running.send_signal(signal.SIGINT)
    running.communicate(timeout=60)
    assert running.returncode != 0


def test_closed_output_is_not_green(console: Machine, lab: RosterLab) -> None:
    robot(lab).freeze()
    reader, writer = os.pipe()
    os.close(reader)
    running = console.start(*STOP, *lab.flags, stdout=writer)
    os.close(writer)
    running.communicate(timeout=60)
    assert running.returncode != 0


def hear(console: Machine, lab: RosterLab) -> None:
    """Have the console hear what is announced meanwhile."""
    console.run("peers", *lab.flags)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    held = sqlite3.connect(path, isolation_level=None)
    held.execute("PRAGMA locking_mode=EXCLUSIVE")
    held.execute("BEGIN EXCLUSIVE")
    try:
        yield
    finally:
        held.close()


@contextmanager
def corrupt(path: Path) -> Iterator[None]:
    for each in path.parent.glob("sightings*"):
        each.write_bytes(b"\x00nothing" * 4096)
        each.chmod(0o600)
    yield


@contextmanager
def truncated(path: Path) -> Iterator[None]:
    os.truncate(path, path.stat().st_size // 2)
    yield


@contextmanager
def emptied(path: Path) -> Iterator[None]:
    for each in path.parent.glob("sightings*"):
        os.truncate(each, 0)
    yield


@contextmanager
def foreign(path: Path) -> Iterator[None]:
    """It is open to others, so that it says nothing."""
    path.chmod(0o666)
    yield


@contextmanager
def a_folder(path: Path) -> Iterator[None]:
    for each in path.parent.glob("sightings*"):
        each.unlink()
    path.mkdir()
    yield


TROUBLES = (locked, corrupt, truncated, emptied, foreign, a_folder)


@pytest.mark.parametrize("trouble", TROUBLES, ids=lambda each: each.__name__)
@pytest.mark.parametrize("how", ["robots", "console"])
def test_memory_that_cannot_be_read_is_not_green(lab: RosterLab, trouble: Callable[[Path], object], how: str) -> None:
    console = known_by(how, lab)
    robot(lab).freeze()
    memory = lab.state("robots" if how == "robots" else "console") / "sightings.db"
    assert memory.exists()
    with trouble(memory):  # type: ignore[attr-defined]
        said = console.run(*STOP, *lab.flags)
    assert said.returncode != 0, said.stdout + said.stderr


def test_full_disk_is_not_green(lab: RosterLab) -> None:
    """The state directory is on a small file system that is full before the robots are heard."""
    full = lab.folder / "full"
    full.mkdir(mode=0o700)
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k,mode=700", "tmpfs", str(full)], check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting needs root")
    lab.stack.callback(subprocess.run, ["umount", str(full)], check=False)
    lab.robots("arm-0", first=True)
    absent = lab.robots("arm-1")
    console = lab.console("full")
    (full / "filler").write_bytes(b"x" * 500_000)
    with pytest.raises(OSError, match="space"):
        (full / "more").write_bytes(b"x" * 100_000)
    hear(console, lab)
    absent.freeze()
    said = console.run(*STOP, *lab.flags, "--json")
    assert said.returncode != 0, json.loads(said.stdout)
