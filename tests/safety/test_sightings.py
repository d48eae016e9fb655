"""Robots that this machine remembers: the file, its bounds, its faults, and processes that share it."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from fixtures.moments import MomentClock
from fixtures.waiting import eventually, said, signalled

from strands_robots.audit import read_audit_log
from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.device_connect.backends.config import network_of
from strands_robots.safety import sighting_file
from strands_robots.safety.identity import ROBOTS, EnrolledKeys, Exemption, KeyFile, SigningIdentity
from strands_robots.safety.network_key import DEVICE_CONNECT, MESH, NetworkKey
from strands_robots.safety.sighting_file import Note, Served, own_run, process_start
from strands_robots.safety.sightings import (
    Known,
    Moment,
    RosterRow,
    Sightings,
    flush_sightings,
)
from strands_robots.safety.statements import Purpose, signed
from strands_robots.utils import ValidationError

HERE = NetworkKey.of(DEVICE_CONNECT, ["tcp/127.0.0.1:7447"])
WEEK_S = 7 * 24 * 3600.0


def found(store: Sightings, now: Moment | None = None) -> dict[str, RosterRow]:
    """The robots by name; nothing was wrong with the file."""
    rows, problem = store.read(now)
    assert problem in ("", sighting_file.CROWDED)
    return {each.name: each for each in rows}


def made_up(count: int, at: Moment, first: int = 0) -> list[Note]:
    return [Note(HERE, f"stranger-{number}", at, stoppable=True) for number in range(first, first + count)]


def test_a_robot_that_was_heard_is_remembered_for_ten_minutes(
    store: Sightings, clock: MomentClock, tmp_path: Path
) -> None:
    store.note(HERE, "arm-1", cell="cell-1", signed_only=True, stoppable=True)
    assert store.flush(5.0)
    another = Sightings(tmp_path / "state", clock)
    arm = found(another)["arm-1"]
    assert (arm.known, arm.cell, arm.signed_only, arm.stoppable) == (Known.HEARD, "cell-1", True, True)
    clock.pass_(599.0)
    assert found(another)["arm-1"].age_s == pytest.approx(599.0)
    clock.pass_(2.0)
    assert found(another) == {}


def test_the_file_is_this_users_alone(store: Sightings) -> None:
    store.note(HERE, "arm-1")
    assert store.flush(5.0)
    assert store.file.path.stat().st_mode & 0o777 == 0o600
    store.file.path.chmod(0o644)
    rows, problem = store.read()
    assert rows == [] and "0644" in problem


def test_nothing_remembered_is_no_problem_and_makes_no_file(store: Sightings) -> None:
    assert store.read() == ([], "")
    assert store.was_here(HERE, "arm-1") is None
    assert not store.file.path.exists()


def test_a_forged_presence_takes_no_fact_of_a_robot_away(store: Sightings, clock: MomentClock) -> None:
    store.note(HERE, "arm-1", cell="cell-1", stoppable=True)
    store.flush(5.0)
    clock.pass_(20.0)
    forger = Sightings(store.directory, clock)
    forger.note(HERE, "arm-1", cell="cell-2", stoppable=False, departing=True)
    forger.flush(5.0)
    arm = found(forger)["arm-1"]
    # In no cell: it counts for a stop of either one.
    assert (arm.cell, arm.stoppable, arm.departed) == ("", True, True)


def test_facts_after_a_bare_heartbeat_are_remembered(store: Sightings) -> None:
    store.note(HERE, "camera-1")
    store.note(HERE, "camera-1", stoppable=False)
    eventually(lambda: store.note(HERE, "camera-1", stoppable=False) or found(store)["camera-1"].stoppable is False)


def test_a_name_that_no_file_can_hold_is_left_out(store: Sightings) -> None:
    for name in ("", "\ud800", "arm\n1", "a" * 257):
        store.note(HERE, name)
    store.note(HERE, "arm-1", cell="\ud800")
    assert set(found(store)) == {"arm-1"}


@pytest.fixture
def robot(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "arm-1", tmp_path / "robot").load_or_make()


def test_a_signed_answer_is_told_from_presence(store: Sightings, robot: SigningIdentity, clock: MomentClock) -> None:
    answer = signed(robot, Purpose.LOCKOUT_STATE, "arm-1", {"nonce": "a" * 32})
    store.note_answer(HERE, "arm-1", Purpose.LOCKOUT_STATE, answer, {"nonce": "a" * 32})
    assert found(store)["arm-1"].known is Known.SIGNED
    clock.pass_(601.0)
    store.note(HERE, "arm-1")
    later = Sightings(store.directory, clock)
    later.note(HERE, "arm-1")
    assert found(later)["arm-1"].known is Known.HEARD


@pytest.mark.parametrize(
    ("name", "purpose", "changed", "expected"),
    [
        pytest.param("arm-1", Purpose.LOCKOUT_STATE, {}, {"nonce": "b" * 32}, id="to another question"),
        pytest.param("arm-1", Purpose.STOP_VERDICT, {}, {"nonce": "a" * 32}, id="of another purpose"),
        pytest.param("arm-2", Purpose.LOCKOUT_STATE, {}, {"nonce": "a" * 32}, id="of another robot"),
        pytest.param("arm-1", Purpose.LOCKOUT_STATE, {"locked": True}, {"nonce": "a" * 32}, id="changed"),
        pytest.param("arm-1", Purpose.LOCKOUT_STATE, {"t": 1.0}, {}, id="old"),
    ],
)
def test_an_answer_that_proves_nothing_is_heard_only(
    store: Sightings,
    robot: SigningIdentity,
    name: str,
    purpose: Purpose,
    changed: dict[str, object],
    expected: dict[str, object],
) -> None:
    answer = {**signed(robot, Purpose.LOCKOUT_STATE, "arm-1", {"nonce": "a" * 32}), **changed}
    store.note_answer(HERE, name, purpose, answer, expected)
    assert found(store)[name].known is Known.HEARD


def test_a_served_robot_counts_while_its_process_lives(store: Sightings, clock: MomentClock) -> None:
    store.serve(HERE, "arm-1", cell="cell-1", signed_only=True)
    store.flush(5.0)
    # Frozen: it refreshes nothing, and is there.
    clock.pass_(3600.0)
    arm = found(store)["arm-1"]
    assert (arm.known, arm.alive, arm.pid, arm.cell, arm.signed_only) == (
        Known.SERVED,
        True,
        os.getpid(),
        "cell-1",
        True,
    )


def test_each_living_process_that_serves_a_robot_is_told(store: Sightings, clock: MomentClock) -> None:
    """One of them may be frozen while the other answers."""
    both = [Served(HERE, "arm-1", pid, process_start(pid), clock()) for pid in (os.getpid(), os.getppid())]
    store.file.write([], both, clock())
    ((row,), problem) = store.read()
    assert ({pid for _, pid in row.processes}, problem) == ({os.getpid(), os.getppid()}, "")
    gone = Served(HERE, "arm-1", os.getppid(), "an earlier process", clock())
    store.file.write([], [replace(both[1], ended=True), gone], clock())
    ((row,), _) = store.read()
    assert row.processes == ((own_run(), os.getpid()),)


def test_an_orderly_end_takes_a_robot_out_though_others_heard_it(store: Sightings, clock: MomentClock) -> None:
    store.note(HERE, "arm-1", stoppable=True)
    store.serve(HERE, "arm-1")
    store.flush(5.0)
    clock.pass_(5.0)
    store.leave(HERE, "arm-1")
    assert found(store) == {}
    clock.pass_(60.0)
    assert store.was_here(HERE, "arm-1") == pytest.approx(60.0)
    elsewhere = Sightings(store.directory, clock)
    elsewhere.note(HERE, "arm-1", stoppable=True)
    assert found(elsewhere)["arm-1"].known is Known.HEARD


def test_a_robot_knows_at_its_start_that_it_was_here(store: Sightings, clock: MomentClock) -> None:
    assert store.was_here(HERE, "arm-1") is None
    store.serve(HERE, "arm-1")
    store.flush(5.0)
    clock.pass_(120.0)
    assert store.was_here(HERE, "arm-1") == pytest.approx(120.0)
    assert store.was_here(NetworkKey.of(MESH, ["tcp/127.0.0.1:7447"]), "arm-1") is None
    assert store.was_here(NetworkKey.of(DEVICE_CONNECT, HERE.where, "other"), "arm-1") is None
    clock.pass_(WEEK_S)
    assert store.was_here(HERE, "arm-1") is None


@pytest.mark.parametrize(
    ("wall_passed", "age"),
    [
        pytest.param(90.0, 90.0, id="a minute and a half"),
        pytest.param(-3600.0, 20.0, id="a clock that was reset counts from the boot"),
        pytest.param(WEEK_S, None, id="a week"),
    ],
)
def test_a_robot_knows_after_a_reboot_that_it_was_here(
    store: Sightings, clock: MomentClock, wall_passed: float, age: float | None
) -> None:
    store.serve(HERE, "arm-1")
    store.note(HERE, "arm-2")
    store.flush(5.0)
    clock.reboot(wall=clock.now.wall + wall_passed)
    after = store.was_here(HERE, "arm-1")
    assert after == (None if age is None else pytest.approx(age))
    # Another boot has other processes, whatever their numbers.
    assert {name: each.alive for name, each in found(store).items()} == (
        {} if age is None else {"arm-1": False, "arm-2": None}
    )


def test_a_reset_of_the_wall_clock_changes_no_age(store: Sightings, clock: MomentClock) -> None:
    store.note(HERE, "arm-1")
    store.flush(5.0)
    clock.now = Moment(clock.now.boot, clock.now.uptime + 30.0, 0.0)
    assert found(store)["arm-1"].age_s == pytest.approx(30.0)


def test_served_robots_are_written_again(store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch) -> None:
    store.serve(HERE, "arm-1")
    store.flush(5.0)
    clock.pass_(100.0)
    store.refresh()
    assert store.was_here(HERE, "arm-1") == pytest.approx(100.0)
    monkeypatch.setattr("strands_robots.safety.sightings.REFRESH_S", 0.0)
    store.refresh()
    store.flush(5.0)
    assert store.was_here(HERE, "arm-1") == pytest.approx(0.0)


def test_ten_thousand_made_up_names_cost_no_true_row_and_little_memory(
    store: Sightings, robot: SigningIdentity, clock: MomentClock
) -> None:
    store.note(HERE, "heard-first", stoppable=True)
    answer = signed(robot, Purpose.LOCKOUT_STATE, "signed", {})
    store.serve(HERE, "served")
    store.flush(5.0)
    tracemalloc.start()
    try:
        for number in range(10_000):
            store.note(HERE, f"stranger-{number}", stoppable=True)
        store.note_answer(HERE, "signed", Purpose.LOCKOUT_STATE, answer)
        assert store.flush(30.0)
        grown = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert grown < 5e6
    rows = found(store)
    assert {"heard-first", "signed", "served"} <= rows.keys()
    assert rows["signed"].known is Known.SIGNED
    assert len(rows) <= sighting_file.ROWS_MAX + 1
    # More commands come, and each hears other names.
    for _ in range(3):
        store.file.write(made_up(4000, clock(), first=int(time.time() * 1e6) % 10**9), [], clock())
    assert {"heard-first", "signed", "served"} <= found(store).keys()


def test_made_up_keys_push_out_no_name_that_was_heard_long_and_are_told(store: Sightings, clock: MomentClock) -> None:
    store.file.write([Note(HERE, "true-robot", clock())], [], clock())
    for each in range(5):
        fakes = [replace(note, signed=clock()) for note in made_up(1024, clock(), first=1024 * each)]
        store.file.write(fakes, [], clock())
    rows, problem = store.file.read(clock())
    assert problem == sighting_file.CROWDED
    assert len(rows) == sighting_file.ROWS_MAX and "true-robot" in {each.name for each in rows}
    clock.pass_(601.0)
    assert store.file.read(clock()) == ([], "")


def test_strangers_key_counts_only_where_no_robot_is_enrolled(store: Sightings, robot: SigningIdentity) -> None:
    store.serve(HERE, "own-1")
    assert store.flush(5.0)
    EnrolledKeys(store.directory).enroll({"arm-9": b"1" * 32}, network=HERE)
    own = KeyFile(ROBOTS, "own-1", store.directory).load_or_make()
    for name, identity in (("arm-1", robot), ("own-1", own)):
        answer = signed(identity, Purpose.LOCKOUT_STATE, name, {"nonce": "a" * 32})
        store.note_answer(HERE, name, Purpose.LOCKOUT_STATE, answer, {"nonce": "a" * 32})
    store.leave(HERE, "own-1")
    store.flush(5.0)
    with sqlite3.connect(store.file.path) as file:
        rows = dict(file.execute("SELECT name, signed_boot IS NOT NULL FROM heard"))
    assert rows == {"arm-1": 0, "own-1": 1}


def test_stale_names_make_place_first(store: Sightings, clock: MomentClock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sighting_file, "ROWS_MAX", 10)
    store.file.write(made_up(10, clock()), [], clock())
    clock.pass_(700.0)
    store.note(HERE, "arm-1")
    assert set(found(store)) == {"arm-1"}


def test_a_damaged_file_is_told_put_aside_and_begun_again(store: Sightings, clock: MomentClock) -> None:
    store.note(HERE, "arm-1")
    store.flush(5.0)
    store.file.path.write_bytes(b"no database" * 1000)
    rows, problem = store.read()
    assert rows == [] and "damaged" in problem
    store.note(HERE, "arm-2")
    store.flush(5.0)
    rows, problem = store.read()
    assert {each.name for each in rows} == {"arm-2"}
    assert "damaged" in problem and "missing" in problem
    assert store.file.path.with_suffix(".damaged").exists()
    clock.pass_(700.0)
    assert store.read() == ([], "")


@pytest.mark.parametrize("breaks", [lambda path: path.mkdir(), lambda path: path.symlink_to("/dev/zero")])
def test_a_file_that_cannot_be_used_is_a_problem_and_no_error(store: Sightings, breaks: Callable[[Path], None]) -> None:
    store.directory.mkdir(mode=0o700)
    breaks(store.file.path)
    store.note(HERE, "arm-1")
    assert not store.flush(2.0)
    rows, problem = store.read()
    assert rows == [] and "sightings.db" in problem
    assert store.was_here(HERE, "arm-1") == 0.0


def test_a_file_of_a_later_release_is_a_problem_and_stays(store: Sightings) -> None:
    store.note(HERE, "arm-1")
    store.flush(5.0)
    with sqlite3.connect(store.file.path) as connection:
        connection.execute("PRAGMA user_version = 7")
    store.note(HERE, "arm-2")
    assert not store.flush(2.0)
    assert "another release" in store.read()[1]
    assert store.file.path.exists()


def test_an_answer_with_the_enrolled_key_ends_an_exemption(
    store: Sightings, robot: SigningIdentity, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enrolled = EnrolledKeys(store.directory)
    enrolled.enroll({"arm-1": robot.public}, network=HERE)
    enrolled.exempt("arm-1", Exemption("retired", "ann", "sold", 1.0))
    stranger = KeyFile(ROBOTS, "arm-1", tmp_path / "stranger").load_or_make()
    asked = {"nonce": "a" * 32}
    store.note(HERE, "arm-1", stoppable=True)
    store.note_answer(
        HERE, "arm-1", Purpose.LOCKOUT_STATE, signed(stranger, Purpose.LOCKOUT_STATE, "arm-1", asked), asked
    )
    store.note_answer(HERE, "arm-1", Purpose.LOCKOUT_STATE, signed(robot, Purpose.LOCKOUT_STATE, "arm-1", {}), {})
    store.flush(5.0)
    assert enrolled.robots()["arm-1"].exemption is not None
    store.note_answer(HERE, "arm-1", Purpose.LOCKOUT_STATE, signed(robot, Purpose.LOCKOUT_STATE, "arm-1", asked), asked)
    store.flush(5.0)
    assert enrolled.robots()["arm-1"].exemption is None
    assert read_audit_log()[-1]["event"] == "exemption_undone"


def test_a_robot_that_is_served_with_the_enrolled_key_ends_its_exemption(
    store: Sightings, robot: SigningIdentity
) -> None:
    enrolled = EnrolledKeys(store.directory)
    enrolled.enroll({"arm-1": robot.public})
    enrolled.exempt("arm-1", Exemption("off", "ann", "", 1.0))
    store.serve(HERE, "arm-1", public=robot.public)
    store.flush(5.0)
    record = enrolled.robots()["arm-1"]
    assert record.exemption is None and record.networks == (HERE,)


# Processes that share the file.

WRITER = """
import sys, time
from pathlib import Path
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.sightings import Sightings
store = Sightings(Path(sys.argv[1]))
network = NetworkKey.parse(sys.argv[2])
store.serve(network, sys.argv[3])
for number in range(int(sys.argv[4])):
    store.note(network, f"{sys.argv[3]}-{number}", stoppable=True)
    store.flush(5.0)
    if number == 3:
        print("written", flush=True)
print("done", flush=True)
time.sleep(float(sys.argv[5]))
"""

HOLDER = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN IMMEDIATE")
connection.execute("UPDATE heard SET departed = 1")
print("held", flush=True)
time.sleep(600)
"""


def test_two_processes_write_at_once_and_lose_nothing(
    tmp_path: Path, child: Callable[..., subprocess.Popen[str]]
) -> None:
    state = tmp_path / "state"
    writers = [child(WRITER, str(state), HERE.text, name, "40", "60") for name in ("a", "b")]
    for each in writers:
        said(each, "written")
    for each in writers:
        said(each, "done")
    rows = found(Sightings(state))
    assert rows.keys() == {"a", "b", *(f"{name}-{number}" for name in "ab" for number in range(40))}
    assert rows["a"].alive and rows["a"].pid == writers[0].pid


def test_a_process_that_is_killed_while_it_writes_leaves_the_file_whole(
    tmp_path: Path, child: Callable[..., subprocess.Popen[str]]
) -> None:
    state = tmp_path / "state"
    for count in range(5):
        writer = child(WRITER, str(state), HERE.text, f"arm-{count}", "100000", "0")
        said(writer, "written")
        writer.kill()
        writer.wait()
        assert process_start(writer.pid) == ""
        rows = found(Sightings(state))
        arm = rows[f"arm-{count}"]
        # Killed: it counts for ten minutes from its last refresh.
        assert (arm.known, arm.alive) == (Known.SERVED, False)
        assert rows[f"arm-{count}-3"].known is Known.HEARD
        assert Sightings(state).was_here(HERE, f"arm-{count}") is not None


def test_a_frozen_process_that_holds_the_file_hinders_no_command(
    store: Sightings, child: Callable[..., subprocess.Popen[str]]
) -> None:
    store.note(HERE, "arm-1", stoppable=True)
    store.serve(HERE, "arm-2")
    assert store.flush(5.0)
    holder = child(HOLDER, str(store.file.path))
    said(holder, "held")
    signalled(holder, signal.SIGSTOP)
    command = Sightings(store.directory)
    command.note(HERE, "arm-3")
    rows, problem = command.read()
    assert {each.name for each in rows} == {"arm-1", "arm-2"}
    assert problem
    assert command.was_here(HERE, "arm-2") is not None
    holder.kill()
    holder.wait()
    assert set(found(command)) == {"arm-1", "arm-2", "arm-3"}


def test_a_process_that_reads_keeps_the_locks_of_its_writer(store: Sightings) -> None:
    """POSIX ends all locks of a process on a file when any of its descriptors is closed."""
    store.note(HERE, "arm-1")
    store.flush(5.0)
    with sqlite3.connect(store.file.path, isolation_level=None) as writer:
        writer.execute("BEGIN IMMEDIATE")
        store.read()
        program = f"import sqlite3; sqlite3.connect({str(store.file.path)!r}, timeout=0.1).execute('BEGIN IMMEDIATE')"
        outcome = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert "locked" in outcome.stderr
        writer.execute("ROLLBACK")


def test_the_end_of_a_process_writes_what_is_queued(tmp_path: Path) -> None:
    state = tmp_path / "state"
    program = (
        "from pathlib import Path\n"
        "from strands_robots.safety.network_key import NetworkKey\n"
        "from strands_robots.safety.sightings import Sightings\n"
        f"Sightings(Path({str(state)!r})).note(NetworkKey.parse({HERE.text!r}), 'arm-1')\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    assert set(found(Sightings(state))) == {"arm-1"}
    flush_sightings(0.0)


# Keys of networks.


@pytest.mark.parametrize(
    "spelling",
    ["tcp/localhost:7447", "zenoh://127.0.0.1:7447", "tls/0.0.0.0:7447", "TCP/127.0.0.1:7447", "tcp/[::1]:7447"],
)
def test_a_network_is_the_same_however_it_is_written(spelling: str) -> None:
    assert NetworkKey.of(DEVICE_CONNECT, [spelling]) == HERE


def test_a_network_key_has_no_credentials() -> None:
    key = NetworkKey.of(DEVICE_CONNECT, ["nats://ann:secret@broker:4222", "nats://backup:4222"], "fleet")
    assert key.text == "device-connect fleet backup:4222,broker:4222"
    assert NetworkKey.parse(key.text) == key
    assert key.meets(NetworkKey.of(DEVICE_CONNECT, ["nats://broker:4222"], "fleet"))
    assert not key.meets(NetworkKey.of(DEVICE_CONNECT, ["nats://broker:4222"]))


@pytest.mark.parametrize(
    ("endpoints", "tenant"),
    [
        ([], "default"),
        (["", " "], ""),
        (["a:1"], "my fleet"),
        (["a:1"], "50%20"),
        ([f"{'h' * 250}-{n}:1" for n in range(40)], "t"),
    ],
    ids=["no endpoint", "empty ones", "a space in the tenant", "a percent sign", "a long list"],
)
def test_every_network_key_is_read_back_as_it_was_written(endpoints: list[str], tenant: str, store: Sightings) -> None:
    key = NetworkKey.of(DEVICE_CONNECT, endpoints, tenant)
    assert NetworkKey.parse(key.text) == key
    store.note(key, "arm-1")
    assert found(store)["arm-1"].network == key


def test_rows_of_unreadable_networks_are_told_for_ten_minutes(store: Sightings, clock: MomentClock) -> None:
    store.file.write([Note(NetworkKey("sea", ("a:1",)), "boat-1", clock()), Note(HERE, "arm-1", clock())], [], clock())
    rows, problem = store.file.read(clock())
    assert [each.name for each in rows] == ["arm-1"]
    assert problem.startswith("1 robots in sightings.db are of networks")
    clock.pass_(601.0)
    assert store.file.read(clock()) == ([], "")


@pytest.mark.parametrize(
    ("link", "where"),
    [
        (loopback_config(12345), ("127.0.0.1:12345",)),
        (LinkConfig(transport="nats"), ("127.0.0.1:4222",)),
        (LinkConfig(), ("multicast",)),
        (LinkConfig(mode="peer", listen=("tcp/0.0.0.0:7000",), multicast=True), ("127.0.0.1:7000", "multicast")),
        (LinkConfig(mode="peer", connect=("tcp/router:7447",), listen=("tcp/0.0.0.0:0",)), ("router:7447",)),
    ],
)
def test_a_link_names_its_network(link: LinkConfig, where: tuple[str, ...]) -> None:
    assert network_of(link) == NetworkKey(DEVICE_CONNECT, where)


@pytest.mark.parametrize("text", ["", "mesh", "mesh default", "sea default a:1", "mesh default " + "a" * 5000])
def test_a_text_that_is_no_network_key_is_refused(text: str) -> None:
    with pytest.raises(ValidationError):
        NetworkKey.parse(text)
