"""The safety audit: chained, signed, shared by processes, and never waited for."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import stat
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots import audit
from strands_robots.audit import (
    audit_log_path,
    flush_audit,
    log_safety_event,
    queue_safety_event,
    read_audit_log,
    verify_audit_integrity,
)
from strands_robots.audit import journal as journal_module
from strands_robots.audit.head import GENESIS
from strands_robots.audit.journal import NAME, AuditEntry, Journal
from strands_robots.audit.verification import verify
from strands_robots.utils import ValidationError


def entry(number: int, peer: str = "arm-1", **payload: Any) -> AuditEntry:
    return AuditEntry(float(number), "emergency_stop", peer, {"n": number, **payload})


def check(journal: Journal, *, keyed: bool = False) -> dict[str, Any]:
    return verify(journal, keyed=keyed)


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    return Journal(tmp_path / "log")


def test_an_event_is_recorded_with_its_fields_sorted_and_compact(state_directory: Path) -> None:
    before = time.time()
    log_safety_event("emergency_stop", "arm-1", {"reason": "smoke"})
    assert flush_audit(20)
    line = (state_directory / NAME).read_text().strip()
    record = json.loads(line)
    assert line == json.dumps(record, sort_keys=True, separators=(",", ":"))
    assert set(record) == {"ts", "event", "peer_id", "payload", "seq", "prev"}
    assert (record["seq"], record["prev"], record["payload"]) == (1, GENESIS, {"reason": "smoke"})
    assert before <= record["ts"] <= time.time()
    assert stat.S_IMODE((state_directory / NAME).stat().st_mode) == 0o600


def test_the_directory_is_made_for_its_owner_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_DIR", str(tmp_path / "audit"))
    log_safety_event("emergency_stop", "arm-1", {})
    assert flush_audit(20)
    assert stat.S_IMODE((tmp_path / "audit").stat().st_mode) == 0o700


def test_numbers_rise_by_peer_and_over_a_restart(journal: Journal) -> None:
    journal.append([entry(1), entry(2, "arm-2"), entry(3)])
    Journal(journal.directory).append([entry(4), entry(5, "arm-2")])
    seqs = [(each["peer_id"], each["seq"]) for each in journal.records()]
    assert seqs == [("arm-1", 1), ("arm-2", 1), ("arm-1", 2), ("arm-1", 3), ("arm-2", 2)]
    assert check(journal)["ok"]


def test_reading_since_gives_what_is_not_older(state_directory: Path) -> None:
    Journal(state_directory).append([entry(1), entry(2), entry(3)])
    assert [each["ts"] for each in read_audit_log(2.0)] == [2.0, 3.0]
    assert len(read_audit_log()) == 3


def test_with_a_key_every_record_is_signed_and_verified(state_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", "a secret")
    for _ in range(3):
        log_safety_event("emergency_stop", "arm-1", {})
    found = verify_audit_integrity()
    assert (found["total"], found["signed"], found["verified"], found["ok"]) == (3, 3, 3, True)
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", "another secret")
    found = verify_audit_integrity()
    assert (found["bad"], found["ok"]) == (3, False)
    (state_directory / NAME).write_bytes(b"")


def test_result_has_the_longer_names_beside_the_short_ones(
    state_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", "a secret")
    for _ in range(4):
        log_safety_event("emergency_stop", "arm-1", {})
    found = verify_audit_integrity()
    assert (found["bad_signature"], found["missing_sig"], found["unverifiable_signed"]) == (0, 0, 0)
    assert (found["psk_present"], found["sequence_gaps"], found["ok"]) == (True, [], True)
    lines = audit_log_path().read_bytes().splitlines(keepends=True)
    audit_log_path().write_bytes(b"".join([lines[0], lines[2].replace(b"emergency", b"emergence"), lines[3]]))
    found = verify_audit_integrity()
    assert (found["bad_signature"], found["sequence_gaps"], found["ok"]) == (found["bad"], [(1, 3)], False)


def records(count: int, monkeypatch: pytest.MonkeyPatch, secret: str = "a secret") -> list[dict[str, Any]]:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", secret)
    for _ in range(count):
        log_safety_event("emergency_stop", "arm-1", {})
    return read_audit_log()


def test_records_that_were_read_are_checked_alone(state_directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = records(4, monkeypatch)
    log_safety_event("emergency_stop", "arm-2", {})
    found = verify_audit_integrity(read)
    assert (found["total"], found["verified"], found["head"], found["ok"]) == (4, 4, "unread", True)
    assert verify_audit_integrity([])["ok"]
    found = verify_audit_integrity([read[0], read[3]])
    assert (found["sequence_gaps"], found["gaps"], found["ok"]) == ([(1, 4)], 1, False)
    found = verify_audit_integrity([*read[:3], {**read[3], "payload": {"n": 1}}])
    assert (found["bad_signature"], found["ok"]) == (1, False)


def test_forged_record_does_not_hide_that_others_were_left_out(
    state_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = records(4, monkeypatch)
    bare = {name: value for name, value in read[1].items() if name != "sig"}
    found = verify_audit_integrity([read[0], {**bare, "seq": 3}, read[3]])
    assert (found["missing_sig"], found["sequence_gaps"], found["ok"]) == (1, [(1, 4)], False)


def test_records_that_were_signed_elsewhere_are_not_ok_without_their_secret(tmp_path: Path) -> None:
    signed = Journal(tmp_path / "other", b"a secret")
    signed.append([entry(1), entry(2)])
    found = verify_audit_integrity(list(signed.records()))
    assert (found["unverifiable_signed"], found["psk_present"], found["ok"]) == (2, False, False)
    plain = [{"event": "emergency_stop", "peer_id": "arm-1", "payload": {}, "seq": seq} for seq in (1, 2)]
    assert verify_audit_integrity(plain)["ok"]
    assert verify_audit_integrity([*plain, {"seq": True}])["torn"] == 1


@pytest.mark.parametrize(
    ("given", "named"), [("text", "records must be"), ({}, "records must be"), ([1], r"records\[0\] must")]
)
def test_records_that_are_no_list_of_objects_are_refused(given: Any, named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        verify_audit_integrity(given)


def test_path_of_the_log_follows_the_setting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STRANDS_MESH_AUDIT_DIR", str(tmp_path / "elsewhere"))
    assert audit_log_path() == tmp_path / "elsewhere" / NAME
    assert not audit_log_path().parent.exists()


def test_a_record_without_a_signature_is_missing_one_where_a_key_is_set(journal: Journal) -> None:
    journal.append([entry(1)])
    found = check(Journal(journal.directory, b"secret"), keyed=True)
    assert (found["missing"], found["ok"]) == (1, False)


def lines_of(journal: Journal) -> list[bytes]:
    return journal.path.read_bytes().splitlines(keepends=True)


def test_a_record_taken_out_of_the_middle_shows_and_says_where(journal: Journal) -> None:
    journal.append([entry(n) for n in range(5)])
    lines = lines_of(journal)
    journal.path.write_bytes(b"".join(lines[:2] + lines[3:]))
    found = check(journal)
    assert not found["ok"]
    assert (found["broken"], found["gaps"]) == (1, 1)
    assert found["breaks"][0]["where"] == f"{NAME}:3"


def test_a_changed_record_shows_even_without_a_key(journal: Journal) -> None:
    journal.append([entry(n) for n in range(3)])
    lines = lines_of(journal)
    lines[1] = lines[1].replace(b'"n":1', b'"n":7')
    journal.path.write_bytes(b"".join(lines))
    assert check(journal)["broken"] == 1


def test_a_log_cut_at_its_end_or_start_shows(journal: Journal) -> None:
    journal.append([entry(n) for n in range(3)])
    lines = lines_of(journal)
    journal.path.write_bytes(b"".join(lines[:2]))
    found = check(journal)
    assert (found["head"], found["ok"]) == ("cut", False)
    journal.path.write_bytes(b"".join(lines[1:]))
    assert check(journal)["broken"] == 1


def test_a_torn_last_line_is_closed_off_and_the_chain_passes_over_it(journal: Journal) -> None:
    journal.append([entry(1)])
    with journal.path.open("ab") as file:
        file.write(b'{"event":"emergency_st')
    Journal(journal.directory).append([entry(2)])
    found = check(journal)
    assert (found["total"], found["torn"], found["ok"]) == (2, 1, True)


@pytest.mark.parametrize("lost", ["mesh_audit.head", None])
def test_the_chain_goes_on_after_the_head_file_was_lost_or_lags(journal: Journal, lost: str | None) -> None:
    journal.append([entry(1), entry(2, "arm-2")])
    if lost:
        (journal.directory / lost).unlink()
    else:
        (journal.directory / "mesh_audit.head").write_text("{not json")
    Journal(journal.directory).append([entry(3)])
    assert [each["seq"] for each in journal.records()] == [1, 1, 2]
    assert check(journal)["ok"]


def test_rotation_keeps_five_files_and_the_chain_and_the_numbers(tmp_path: Path) -> None:
    journal = Journal(tmp_path, max_bytes=500)
    for number in range(60):
        journal.append([entry(number)])
    assert len(journal.files()) == 6
    records = list(journal.records())
    assert records[-1]["seq"] == 60
    assert records[0]["seq"] > 1
    assert check(journal)["ok"]
    journal.files()[0].unlink()
    assert not check(journal)["ok"]


@pytest.mark.parametrize(
    "payload",
    [{"x": object()}, {"x": math.nan}, {"x": {1, 2}}, {"x": "y" * 300_000}, {("a", "b"): 1}, [object()], "\ud800"],
)
def test_what_json_cannot_hold_is_recorded_with_what_could_be_kept(payload: Any) -> None:
    log_safety_event("odd", "arm-1", payload)
    (record,) = read_audit_log()
    whole = record["payload"] == payload
    assert whole or "SERIALISE_FAILED" in record["payload"]
    found = verify_audit_integrity()
    assert (found["replaced"], found["ok"]) == (int(not whole), whole)


def test_a_payload_nested_beyond_measure_is_recorded_as_such() -> None:
    deep: dict[str, Any] = {}
    for _ in range(100_000):
        deep = {"d": deep}
    log_safety_event("odd", "arm-1", {"deep": deep})
    (record,) = read_audit_log()
    assert "SERIALISE_FAILED" in record["payload"]


def test_a_link_in_place_of_the_log_is_not_followed_and_the_record_waits(
    state_directory: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    target = tmp_path / "elsewhere"
    target.write_text("")
    (state_directory / NAME).symlink_to(target)
    log_safety_event("emergency_stop", "arm-1", {"reason": "smoke"})
    assert not flush_audit(0.2)
    eventually(lambda: "smoke" in caplog.text and "CRITICAL" in caplog.text, what="the writer's complaint")
    assert target.read_text() == ""
    (state_directory / NAME).unlink()
    assert flush_audit(20)
    assert read_audit_log()[0]["payload"] == {"reason": "smoke"}


def test_queueing_does_not_wait_while_another_process_holds_the_lock(state_directory: Path) -> None:
    with (state_directory / "mesh_audit.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        queue_safety_event("emergency_stop", "arm-1", {})
        assert not flush_audit(0.1)
    assert flush_audit(20)
    assert len(read_audit_log()) == 1


def test_an_event_that_was_logged_is_in_the_file(state_directory: Path) -> None:
    for number in range(3):
        log_safety_event("emergency_stop", "arm-1", {"n": number})
        assert f'"n":{number}' in (state_directory / NAME).read_text()


def test_logging_waits_for_a_lock_no_longer_than_its_bound(
    state_directory: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(audit, "FLUSH_S", 0.2)
    monkeypatch.setattr(journal_module, "LOCK_S", 0.5)
    with (state_directory / "mesh_audit.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        log_safety_event("emergency_stop", "arm-1", {"reason": "smoke"})
        assert "not on disk within 0.2 s: emergency_stop arm-1" in caplog.text
        eventually(lambda: "locked for 0.5 s" in caplog.text, what="the writer's complaint")
        with pytest.raises(OSError, match="locked"):
            verify_audit_integrity()
    assert eventually(lambda: flush_audit(0.2))
    assert [each["payload"] for each in read_audit_log()] == [{"reason": "smoke"}]


@pytest.mark.parametrize("name", [NAME, "mesh_audit.head", "mesh_audit.lock", "mesh_audit.draft", "kept/" + NAME])
def test_a_pipe_in_place_of_a_file_holds_up_nobody(
    state_directory: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """It may be taken for an attack on the audit; it may not hang who stops a robot, or asks what happened."""
    pipe = state_directory / name
    pipe.parent.mkdir(mode=0o700, exist_ok=True)
    os.mkfifo(pipe)
    log_safety_event("emergency_stop", "arm-1", {"epoch": "e" * 32})
    monkeypatch.setattr(audit, "FLUSH_S", 0.2)
    read_audit_log()
    with contextlib.suppress(OSError):  # it says that it cannot read what is there
        verify_audit_integrity()
    pipe.unlink()
    assert eventually(lambda: flush_audit(0.2))
    assert [each["event"] for each in read_audit_log()][-1] == "emergency_stop"


def test_a_disk_that_hangs_holds_up_no_queued_record_and_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    wedged, free = threading.Event(), threading.Event()
    append = Journal.append

    def hanging(journal: Journal, entries: Any) -> None:
        wedged.set()
        assert free.wait(60)
        append(journal, entries)

    monkeypatch.setattr(Journal, "append", hanging)
    monkeypatch.setattr(audit, "QUEUED_MAX", 10)
    monkeypatch.setattr(audit, "FLUSH_S", 0.1)
    queue_safety_event("e", "arm-1", {})
    assert wedged.wait(20)
    for number in range(50):
        queue_safety_event("e", "arm-1", {"n": number})
    queue_safety_event("emergency_stop", "arm-1", {"epoch": "e" * 32})
    log_safety_event("e", "arm-1", {"n": "waits"})
    free.set()
    monkeypatch.setattr(audit, "FLUSH_S", 20.0)
    records = read_audit_log()
    lost = sum(each["payload"]["lost"] for each in records if each["event"] == "audit_records_lost")
    assert lost + sum(each["event"] == "e" for each in records) == 52
    assert lost >= 40
    assert [each["event"] for each in records].count("emergency_stop") == 1


def test_signed_records_without_their_secret_are_not_ok(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    journal = Journal(tmp_path, b"a secret")
    journal.append([entry(1), entry(2)])
    found = check(Journal(tmp_path))
    assert (found["signed"], found["verified"], found["ok"]) == (2, 0, False)
    assert "were not verified" in found["breaks"][0]["why"]


def test_a_process_goes_on_with_the_secret_it_began_with(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for stated in ("a secret", "", "another", None):
        if stated is None:
            monkeypatch.delenv("STRANDS_MESH_AUDIT_PSK")
        else:
            monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", stated)
        log_safety_event("emergency_stop", "arm-1", {})
    assert caplog.text.count("goes on signing the safety audit") == 2, "once each: gone, and changed"
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", "a secret")
    found = verify_audit_integrity()
    assert (found["total"], found["verified"], found["ok"]) == (4, 4, True)


def test_a_process_without_the_secret_marks_the_signed_audit_that_it_writes_to(tmp_path: Path) -> None:
    Journal(tmp_path, b"a secret").append([entry(1)])
    Journal(tmp_path).append([entry(2)])
    assert "it is signed, and this process has no secret" in str([*Journal(tmp_path).records()])
    assert not check(Journal(tmp_path))["ok"]
    assert not check(Journal(tmp_path, b"a secret"), keyed=True)["ok"]


def test_records_that_are_not_on_the_disk_yet_are_not_ok(
    state_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log_safety_event("e", "arm-1", {})
    assert verify_audit_integrity()["ok"]
    monkeypatch.setattr(audit, "FLUSH_S", 0.1)
    monkeypatch.setattr(Journal, "append", lambda journal, entries: (_ for _ in ()).throw(OSError("full")))
    log_safety_event("e", "arm-1", {})
    found = verify_audit_integrity()
    assert (found["total"], found["ok"]) == (1, False)
    assert "not on the disk yet" in str(found["breaks"])


def test_a_foreign_repr_that_hangs_holds_up_its_caller_alone() -> None:
    asked, answer = threading.Event(), threading.Event()

    class Slow:
        def __repr__(self) -> str:
            asked.set()
            assert answer.wait(60)
            return "Slow()"

    caller = threading.Thread(target=log_safety_event, args=("odd", "arm-1", {"x": Slow()}))
    caller.start()
    try:
        assert asked.wait(20)
        log_safety_event("emergency_stop", "arm-1", {})
        assert [each["event"] for each in read_audit_log()] == ["emergency_stop"]
    finally:
        answer.set()
        caller.join(20)


def test_many_threads_lose_nothing() -> None:
    def write(peer: str) -> None:
        for _ in range(50):
            log_safety_event("e", peer, {})

    threads = [threading.Thread(target=write, args=(f"arm-{n}",)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = verify_audit_integrity()
    assert (found["total"], found["gaps"], found["ok"]) == (400, 0, True)


def test_oldest_records_beyond_the_bound_are_replaced_by_their_count(
    state_directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "PENDING_MAX", 10)
    (state_directory / NAME).symlink_to("/nonexistent/elsewhere")
    for number in range(30):
        log_safety_event("e", "arm-1", {"n": number})
    assert not flush_audit(0.1)
    (state_directory / NAME).unlink()
    eventually(lambda: flush_audit(0.2))
    records = read_audit_log()
    lost = sum(each["payload"]["lost"] for each in records if each["event"] == "audit_records_lost")
    assert lost + sum(each["event"] == "e" for each in records) == 30
    assert records[-1]["payload"] == {"n": 29}


def test_records_of_the_older_package_are_checked_by_their_signatures(monkeypatch: pytest.MonkeyPatch) -> None:
    """As strands-robots 0.5 wrote it: no chain, and the signature over the sorted compact rest."""
    monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", "s")
    signed = "e0a0bf7a022a7026d76b404a984c8e0db6de19f52b8961ffefcc228a45efa424"
    record = {"event": "emergency_stop", "peer_id": "arm-1", "seq": 1, "sig": signed, "ts": 1795745865.2665324}
    assert verify_audit_integrity([{**record, "payload": {"n": 0, "t": "é"}}])["ok"]
    assert not verify_audit_integrity([{**record, "payload": {"n": 1, "t": "é"}}])["ok"]
