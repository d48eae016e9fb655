"""Records that matter most outlast every noise, and are checked like the others."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from fixtures.audit_files import entry

from strands_robots import audit
from strands_robots.audit import (
    FOLDER,
    LastingRecords,
    flush_audit,
    journal,
    lasting_journal,
    log_safety_event,
    read_audit_log,
    verify_audit_integrity,
)

EPOCH = "0123456789abcdef0123456789abcdef"


@pytest.fixture(autouse=True)
def signed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", "a secret")


@pytest.fixture
def small_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal.Journal.__init__, "__defaults__", (None, 2000, 5))


def stop_and_resume() -> None:
    log_safety_event("emergency_stop", "arm-1", {"epoch": EPOCH, "stopped": True})
    log_safety_event("emergency_stop", "arm-2", {"epoch": EPOCH, "stopped": False})
    log_safety_event("resume_ok", "arm-1", {"epoch": EPOCH})


def noise(count: int = 200) -> None:
    for number in range(count):
        log_safety_event("command_refused", "arm-1", {"n": number})
        if number % 10 == 0:
            flush_audit(20)
    assert flush_audit(20)


@pytest.mark.usefixtures("small_files")
def test_first_stop_its_verdicts_and_its_resume_outlast_later_noise(state_directory: Path) -> None:
    stop_and_resume()
    noise()
    kinds = [(each["event"], each["peer_id"]) for each in read_audit_log()]
    assert kinds[:3] == [("emergency_stop", "arm-1"), ("emergency_stop", "arm-2"), ("resume_ok", "arm-1")]
    assert b"emergency_stop" not in b"".join(path.read_bytes() for path in state_directory.glob("mesh_audit.jsonl*"))
    found = verify_audit_integrity()
    assert (found["kept"], found["ok"]) == (4, True)


def test_repeated_record_of_a_stop_is_kept_once(tmp_path: Path) -> None:
    kept = lasting_journal(tmp_path, None, tmp_path / "anchor")
    lasting = LastingRecords(kept)
    for _ in range(3):
        lasting.write([entry(1, epoch=EPOCH), entry(2, epoch=EPOCH), entry(3, event="noise")])
    LastingRecords(lasting_journal(tmp_path, None, tmp_path / "anchor")).write([entry(4, epoch=EPOCH)])
    assert [each["payload"].get("n") for each in kept.records()] == [None, 1]


@pytest.mark.parametrize("what", ["changed", "cut", "deleted", "deleted with its anchor"])
def test_change_of_the_kept_records_fails_the_check(state_directory: Path, what: str) -> None:
    stop_and_resume()
    assert flush_audit(20)
    log = state_directory / FOLDER / "mesh_audit.jsonl"
    if what == "changed":
        log.write_bytes(log.read_bytes().replace(b'"stopped":false', b'"stopped":true'))
    elif what == "cut":
        log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:-1]))
    else:
        shutil.rmtree(log.parent)
        if "anchor" in what:
            next((state_directory / "anchors").glob("*-kept")).unlink()
    assert not verify_audit_integrity()["ok"]
    log_safety_event("emergency_stop", "arm-1", {"epoch": EPOCH[::-1]})
    assert not verify_audit_integrity()["ok"]


def test_queue_that_is_full_sheds_noise_before_a_stop(state_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit, "PENDING_MAX", 10)
    (state_directory / "mesh_audit.jsonl").symlink_to("/nonexistent/elsewhere")
    stop_and_resume()
    for number in range(40):
        log_safety_event("command_refused", "arm-1", {"n": number})
    assert not flush_audit(0.1)
    (state_directory / "mesh_audit.jsonl").unlink()
    assert flush_audit(20)
    events = [each["event"] for each in read_audit_log()]
    assert events.count("emergency_stop") == 2
    assert "resume_ok" in events
    assert events.count("command_refused") < 10


def test_full_log_of_kept_records_takes_no_more_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("strands_robots.audit.LASTING_MAX_BYTES", 400)
    kept = lasting_journal(tmp_path, None, tmp_path / "anchor")
    lasting = LastingRecords(kept)
    for number in range(9):
        lasting.write([entry(number, epoch=f"{number:032x}")])
    assert 1 < len(list(kept.records())) < 9
    assert caplog.text.count("is full") == 1
