"""Another machine that saw the head finds what one machine alone cannot."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.audit_files import copy_files, entry, restore_files, signed_journal

from strands_robots.audit import audit_head, flush_audit, log_safety_event, log_witness, read_audit_log
from strands_robots.audit.head import Anchor
from strands_robots.audit.journal import Journal
from strands_robots.audit.verification import WITNESS, compare, stated_head, verify, witnessed
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.stop_link import ESTOP, VERDICT, notification

HEAD = {"log": "a" * 32, "count": 7, "last": "b" * 64}


def head_of(journal: Journal) -> dict[str, Any]:
    head = journal.written
    assert head is not None
    stated = stated_head(Anchor(head.log, head.count, head.last))
    assert stated is not None
    return stated


def witness_file(folder: Path, *heads: dict[str, Any]) -> Path:
    seen = Journal(folder / "controller")
    facts = {"witness": "safety-1", "signed": True}
    seen.append([entry(0, "arm-1", WITNESS, **head, **facts) for head in heads])
    return seen.path


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    journal = signed_journal(tmp_path / "robot", max_bytes=1500)
    for number in range(4):
        journal.append([entry(number)])
    return journal


def test_log_head_and_anchor_rolled_back_together_are_found_by_a_witness(journal: Journal, tmp_path: Path) -> None:
    older = copy_files(journal, anchor=True)
    for number in range(4, 6):
        journal.append([entry(number)])
    file = witness_file(tmp_path, head_of(journal))
    assert compare(journal, [file]) == (1, [])
    restore_files(journal, older)
    restarted = signed_journal(journal.directory, 1500)
    assert verify(restarted, keyed=True)["head"] == "ok", "one machine alone finds nothing"
    seen, gone = compare(restarted, [file])
    assert seen == 1
    assert "record 6, which safety-1 (signed) saw, is not there" in gone[0]["why"]
    for number in range(10, 16):
        restarted.append([entry(number)])
    assert len(compare(restarted, [file])[1]) == 1, "written on, it has another record 6"


def test_audit_that_was_deleted_whole_is_found_by_a_witness(journal: Journal, tmp_path: Path) -> None:
    file = witness_file(tmp_path, head_of(journal))
    for path in [*journal.files(), journal.path.with_suffix(".head"), *(journal.directory / "anchors").iterdir()]:
        path.unlink()
    restarted = signed_journal(journal.directory)
    restarted.append([entry(99)])
    assert len(compare(restarted, [file])[1]) == 1


def test_record_that_was_rotated_out_is_no_finding(journal: Journal, tmp_path: Path) -> None:
    file = witness_file(tmp_path, head_of(journal))
    for number in range(4, 60):
        journal.append([entry(number)])
    assert not any(each["payload"]["n"] < 4 for each in journal.records())
    assert compare(journal, [file]) == (1, [])


def test_witness_of_another_log_is_not_counted(journal: Journal, tmp_path: Path) -> None:
    assert compare(journal, [witness_file(tmp_path, HEAD)]) == (0, [])


@pytest.mark.parametrize(
    "value",
    [None, 7, [], {}, {**HEAD, "count": True}, {**HEAD, "count": 0}, {**HEAD, "last": "b"}, {**HEAD, "log": None}],
)
def test_what_is_no_head_is_no_witness(value: object) -> None:
    assert witnessed(value) is None
    log_witness("safety-1", "arm-1", value, signed=True)
    assert read_audit_log() == []


def test_own_head_is_not_witnessed() -> None:
    log_safety_event("emergency_stop", "arm-1", {})
    assert flush_audit(20)
    log_witness("safety-1", "arm-1", audit_head(), signed=True)
    assert [each["event"] for each in read_audit_log()] == ["emergency_stop"]


class AnsweringLink:
    """A link whose robot answers each stop with the head of its audit."""

    def open(self, events: object, hear: Callable[[str, str, bytes], None], on_state: object) -> None:
        self._hear = hear
        self.up = True

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        if event == ESTOP:
            epoch = json.loads(payload)["params"]["estop_id"]
            for robot in ("arm-1", "invented"):
                answer = {"device_id": robot, "estop_id": epoch, "stopped": True, "audit": HEAD}
                self._hear(VERDICT, robot, notification(VERDICT, answer))
        return True

    def close(self) -> None:
        self.up = False


def test_controller_records_the_head_in_the_verdict_of_each_expected_robot() -> None:
    SafetyController("safety-1", AnsweringLink).stop(["arm-1"], deadline_s=20)
    (record,) = read_audit_log()
    assert (record["event"], record["peer_id"]) == (WITNESS, "arm-1")
    assert record["payload"] == {**HEAD, "witness": "safety-1", "signed": False}
