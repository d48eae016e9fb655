from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.cli.conftest import Run

from strands_robots.audit import audit_head, flush_audit, log_safety_event
from strands_robots.audit.journal import AuditEntry, Journal
from strands_robots.audit.verification import WITNESS

EPOCH = "0123456789abcdef0123456789abcdef"


def record(count: int = 3) -> None:
    for number in range(count):
        log_safety_event("emergency_stop", "arm-1", {"epoch": EPOCH, "number": number})
    log_safety_event("resume_local", "arm-2", {"who": "ada\x1b[2J", "epochs": [EPOCH]})
    assert flush_audit(20)


def test_tail_prints_the_last_records_without_control_sequences(run: Run) -> None:
    record()
    output = run("audit", "tail")
    assert output.exit_code == 0
    assert "arm-1" in output.stdout and "resume_local" in output.stdout
    assert "\x1b" not in output.stdout
    rows = [json.loads(line) for line in run("audit", "tail", "-n", "2", "--json").stdout.splitlines()]
    assert [each["event"] for each in rows] == ["emergency_stop", "resume_local"]


def test_tail_of_an_empty_audit_succeeds(run: Run) -> None:
    assert run("audit", "tail").exit_code == 0
    assert run("audit", "tail", "-n", "0").exit_code == 2


def test_records_are_found_by_stop_robot_and_event(run: Run) -> None:
    record()

    def many(*arguments: str) -> int:
        return len(run("audit", "show", *arguments, "--json").stdout.splitlines())

    assert many(EPOCH) == 4
    assert many("arm-2") == 1
    assert many("emergency_stop") == 3
    assert many("--last", "60") == 4
    assert run("audit", "show", "arm-9").exit_code == 1


def test_changed_record_fails_verification(run: Run, state_directory: Path) -> None:
    record()
    assert run("audit", "verify").exit_code == 0
    log = next(path for path in state_directory.iterdir() if path.suffix == ".jsonl")
    log.write_bytes(log.read_bytes().replace(b'"number":1', b'"number":7'))
    result = run("audit", "verify", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["broken"] == 1


@pytest.mark.parametrize("secret", ["", "a-secret-of-the-operator"])
def test_log_of_another_writer_alone_is_not_called_intact(
    run: Run, state_directory: Path, monkeypatch: pytest.MonkeyPatch, secret: str
) -> None:
    if secret:
        monkeypatch.setenv("STRANDS_MESH_AUDIT_PSK", secret)
    older = {"event": "emergency_stop", "payload": {}, "peer_id": "arm-1", "seq": 0, "ts": 1.0}
    (state_directory / "mesh_audit.jsonl").write_text(3 * (json.dumps(older) + "\n"), encoding="utf-8")
    result = run("audit", "verify")
    assert result.exit_code == 1
    assert "3 lines of another writer, perhaps strands-robots 0.5: use a new STRANDS_MESH_AUDIT_DIR." in result.output
    assert "intact" not in result.output
    assert json.loads(run("audit", "verify", "--json").stdout)["ok"] is False


def test_audit_is_compared_with_the_files_of_other_machines(run: Run, tmp_path: Path) -> None:
    record()
    head = audit_head()
    assert head is not None
    files = []
    for name, seen in (("same", head), ("later", {**head, "count": 9, "last": "c" * 64})):
        other = Journal(tmp_path / name)
        other.append([AuditEntry(0.0, WITNESS, "arm-1", {**seen, "witness": "safety-1", "signed": True})])
        files.append(str(other.path))
    assert run("audit", "verify", "--with", files[0]).exit_code == 0
    result = run("audit", "verify", "--with", files[0], "--with", files[1])
    assert result.exit_code == 1
    assert "record 9" in result.output
    assert run("audit", "verify", "--with", str(tmp_path / "absent")).exit_code == 1
