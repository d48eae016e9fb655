"""The audit among real processes: many writers at once, one killed in the middle, a disk that fills."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fixtures.plane_process import planned
from fixtures.waiting import eventually

from strands_robots.audit import flush_audit, log_safety_event, read_audit_log
from strands_robots.audit.journal import LOCK_S, NAME, AuditEntry, Journal
from strands_robots.audit.verification import verify

WRITER = """
import sys
from pathlib import Path
from strands_robots.audit.journal import LOCK_S, NAME, AuditEntry, Journal
journal = Journal(Path(sys.argv[1]))
for number in range(int(sys.argv[3])):
    journal.append([AuditEntry(0.0, "e", sys.argv[2], {"n": number, "fill": "x" * 500})])
    print(number, flush=True)
"""

FULL = """
import resource, sys
from strands_robots.audit import flush_audit, log_safety_event
resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900))
for number in range(8):
    log_safety_event("e", "arm-1", {"n": number})
    print(flush_audit(0.2 if number else 20.0), flush=True)
"""


DYING = """
import os
from strands_robots.audit import log_safety_event
log_safety_event("emergency_stop", "arm-1", {"reason": "smoke"})
os._exit(0)
"""

DROPPING = """
import os
from strands_robots.audit import log_safety_event
log_safety_event("e", "arm-1", {})
del os.environ["STRANDS_MESH_AUDIT_PSK"]
log_safety_event("e", "arm-1", {})
"""


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command, known = [sys.executable, *arguments], {**os.environ, **environment}
    return subprocess.run(command, env=known, capture_output=True, text=True, timeout=100, check=False)


def audit_verify(**environment: str) -> tuple[int, str]:
    run = python("-m", "strands_robots.cli", "audit", "verify", **environment)
    return run.returncode, " ".join((run.stdout + run.stderr).split())


def writer(directory: Path, peer: str, count: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(directory), peer, str(count)], stdout=subprocess.PIPE, text=True
    )


def test_four_processes_at_once_leave_one_whole_chain(tmp_path: Path) -> None:
    writers = [writer(tmp_path, peer, 40) for peer in ("arm-1", "arm-1", "arm-2", "arm-3")]
    for each in writers:
        each.communicate(timeout=60)
        assert each.returncode == 0
    found = verify(Journal(tmp_path), keyed=False)
    assert (found["total"], found["gaps"], found["ok"]) == (160, 0, True)


@pytest.mark.parametrize("after", [1, 5, 20])
def test_a_writer_killed_in_the_middle_loses_nothing_it_acknowledged(tmp_path: Path, after: int) -> None:
    process = writer(tmp_path, "arm-1", 100_000)
    assert process.stdout is not None
    for _ in range(after):
        acknowledged = int(process.stdout.readline())
    os.kill(process.pid, signal.SIGKILL)
    rest = process.communicate()[0].split()
    acknowledged = max([acknowledged, *map(int, rest)])
    journal = Journal(tmp_path)
    assert {each["payload"]["n"] for each in journal.records()} >= set(range(acknowledged + 1))
    journal.append([AuditEntry(0.0, "e", "arm-1", {"n": -1})])
    found = verify(journal, keyed=False)
    assert found["ok"], found


def test_full_disk_is_logged_and_acknowledged_records_stay(tmp_path: Path, state_directory: Path) -> None:
    run = subprocess.run([sys.executable, "-c", FULL], capture_output=True, text=True, timeout=60, check=True)
    answers = [line == "True" for line in run.stdout.split()]
    assert True in answers
    assert False in answers
    assert "cannot be written" in run.stderr
    journal = Journal(state_directory)
    kept = [each["payload"]["n"] for each in journal.records()]
    assert kept[: answers.count(True)] == list(range(answers.count(True)))
    journal.append([AuditEntry(0.0, "e", "arm-1", {"n": 99})])
    assert verify(journal, keyed=False)["ok"]


def test_directory_that_cannot_be_written_delays_no_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "file"
    place.write_text("in the way")
    monkeypatch.setenv("STRANDS_MESH_AUDIT_DIR", str(place))
    log_safety_event("e", "arm-1", {})
    assert not flush_audit(0.2)
    place.unlink()
    assert eventually(lambda: flush_audit(0.2))


def test_a_logged_event_outlasts_the_process_that_ends_at_once() -> None:
    for count in range(1, 4):
        assert python("-c", DYING).returncode == 0
        assert [each["payload"] for each in read_audit_log()] == [{"reason": "smoke"}] * count


def test_a_dropped_secret_leaves_no_unsigned_record_and_none_that_passes_unverified() -> None:
    secret = {"STRANDS_MESH_AUDIT_PSK": "the secret"}
    run = python("-c", DROPPING, **secret)
    assert (run.returncode, "STRANDS_MESH_AUDIT_PSK is gone" in run.stderr) == (0, True)
    code, told = audit_verify(**secret)
    assert (code, "The audit is intact: 2 records." in told) == (0, True), told
    code, told = audit_verify()
    assert (code, "2 of 2 records are signed, and STRANDS_MESH_AUDIT_PSK is not set here" in told) == (1, True), told


def test_facts_that_could_not_be_written_are_named_by_the_check() -> None:
    log_safety_event("odd", "arm-1", {"x": object()})
    code, told = audit_verify()
    assert (code, "the facts of 1 of 1 records could not be written" in told) == (1, True), told


def test_an_audit_that_another_process_keeps_locked_delays_no_stop_and_no_verdict(state_directory: Path) -> None:
    with planned(["arm-1", "arm-2"], STRANDS_STATE_DIR=str(state_directory)) as site:
        with (state_directory / "mesh_audit.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            for _ in range(3):
                site.ask("move")
                began = time.monotonic()
                assert site.ask("stop") == [[True, True]] * 2
                assert time.monotonic() - began < LOCK_S / 2, "the audit's lock was waited for"
                site.ask("clear")
            assert not (state_directory / NAME).exists()
        eventually(lambda: len(_engaged(state_directory)) == 6, what="every stop in the audit")


def _engaged(directory: Path) -> list[str]:
    return [each["peer_id"] for each in Journal(directory).records() if each["event"] == "emergency_stop"]
