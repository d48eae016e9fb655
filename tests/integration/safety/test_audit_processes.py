"""The audit among real processes: many writers at once, one killed in the middle, a disk that fills."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.waiting import eventually

from strands_robots.audit import flush_audit, log_safety_event
from strands_robots.audit.journal import AuditEntry, Journal
from strands_robots.audit.verification import verify

WRITER = """
import sys
from pathlib import Path
from strands_robots.audit.journal import AuditEntry, Journal
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
