"""An attacker without the secret who may write every file of the audit: all found, for good, by the check."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.audit_files import copy_files, dying_after, entry, restore_files, signed_journal

from strands_robots.audit.head import Head
from strands_robots.audit.journal import BROKEN, Journal
from strands_robots.audit.verification import verify


def lines(journal: Journal) -> list[bytes]:
    return journal.path.read_bytes().splitlines(keepends=True)


def head_file(journal: Journal) -> Path:
    return journal.path.with_suffix(".head")


def anchor_file(journal: Journal) -> Path:
    (found,) = (journal.directory / "anchors").iterdir()
    return found


def cut_the_tail(journal: Journal) -> None:
    journal.path.write_bytes(b"".join(lines(journal)[:-2]))


def keep_the_last_two(journal: Journal) -> None:
    kept = b"".join(lines(journal)[-2:])
    journal.path.unlink()
    journal.path.write_bytes(kept)


def keep_the_last_two_in_place(journal: Journal) -> None:
    journal.path.write_bytes(b"".join(lines(journal)[-2:]))


def delete_log_and_head(journal: Journal) -> None:
    journal.path.unlink()
    head_file(journal).unlink()


def delete_the_head_and_cut_the_first(journal: Journal) -> None:
    head_file(journal).unlink()
    journal.path.write_bytes(b"".join(lines(journal)[2:]))


def delete_the_head_and_cut_the_last(journal: Journal) -> None:
    head_file(journal).unlink()
    journal.path.write_bytes(b"".join(lines(journal)[:-2]))


def delete_the_head(journal: Journal) -> None:
    head_file(journal).unlink()


def add_garbage(journal: Journal) -> None:
    with journal.path.open("ab") as file:
        file.write(b'{"event":"emergency_st')


def add_a_blank_line(journal: Journal) -> None:
    with journal.path.open("ab") as file:
        file.write(b"\n")


def repeat_the_last_record(journal: Journal) -> None:
    with journal.path.open("ab") as file:
        file.write(lines(journal)[-1])


def cut_the_last_newline(journal: Journal) -> None:
    journal.path.write_bytes(journal.path.read_bytes()[:-1])


def swap_two_records(journal: Journal) -> None:
    found = lines(journal)
    found[1], found[2] = found[2], found[1]
    journal.path.write_bytes(b"".join(found))


def delete_the_anchor(journal: Journal) -> None:
    anchor_file(journal).unlink()


def add_a_blank_to_the_head(journal: Journal) -> None:
    head_file(journal).write_bytes(head_file(journal).read_bytes() + b" ")


TAMPERINGS: list[Callable[[Journal], None]] = [
    cut_the_tail,
    keep_the_last_two,
    keep_the_last_two_in_place,
    delete_log_and_head,
    delete_the_head_and_cut_the_first,
    delete_the_head_and_cut_the_last,
    delete_the_head,
    add_garbage,
    add_a_blank_line,
    repeat_the_last_record,
    cut_the_last_newline,
    swap_two_records,
    delete_the_anchor,
    add_a_blank_to_the_head,
]


@pytest.fixture(autouse=True)
def no_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is checked here are the files; the disk below them may take its time."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    journal = signed_journal(tmp_path)
    for number in range(6):
        journal.append([entry(number)])
    assert check(journal)["ok"]
    return journal


def check(journal: Journal) -> dict[str, Any]:
    return verify(signed_journal(journal.directory), keyed=True)


@pytest.mark.parametrize("tamper", TAMPERINGS, ids=lambda each: each.__name__)
def test_tampering_is_found_before_the_next_record(journal: Journal, tamper: Callable[[Journal], None]) -> None:
    tamper(journal)
    assert not check(journal)["ok"]


@pytest.mark.parametrize(("old", "new"), [(b'"sig":"', '"sig":"\u1000'.encode()), (b'"n":3', b'"n":NaN')])
def test_record_that_no_writer_could_sign_is_found_and_no_crash(journal: Journal, old: bytes, new: bytes) -> None:
    written = journal.path.read_bytes()
    assert old in written
    journal.path.write_bytes(written.replace(old, new, 1))
    found = check(journal)
    assert (found["bad"], found["ok"]) == (1, False)
    assert "the signature does not hold" in [each["why"] for each in found["breaks"]]


@pytest.mark.parametrize("restarted", [False, True], ids=["running writer", "restarted writer"])
@pytest.mark.parametrize("tamper", TAMPERINGS, ids=lambda each: each.__name__)
def test_tampering_is_found_after_more_records(
    journal: Journal, tamper: Callable[[Journal], None], restarted: bool
) -> None:
    tamper(journal)
    writer = signed_journal(journal.directory) if restarted else journal
    for number in range(10, 13):
        writer.append([entry(number)])
        assert not check(journal)["ok"]


def test_mismatch_that_the_writer_sees_is_one_signed_record(journal: Journal) -> None:
    cut_the_tail(journal)
    for number in range(10, 13):
        journal.append([entry(number)])
    alarms = [each for each in journal.records() if each["event"] == BROKEN]
    assert len(alarms) == 1
    assert "cut from" in alarms[0]["payload"]["why"]
    assert journal.seal.valid(alarms[0])
    found = check(journal)
    assert (found["tampered"], found["ok"]) == (1, False)


def test_mismatch_is_reported_after_its_record_was_rotated_away(tmp_path: Path) -> None:
    journal = signed_journal(tmp_path, max_bytes=900)
    for number in range(4):
        journal.append([entry(number)])
    cut_the_tail(journal)
    for number in range(60):
        journal.append([entry(number)])
    assert not any(each["event"] == BROKEN for each in journal.records())
    found = check(journal)
    assert (found["broken"], found["head"], found["tampered"], found["ok"]) == (0, "ok", 1, False)
    assert "cut from" in found["breaks"][0]["why"]


def test_log_and_head_rolled_back_together_are_older_than_the_anchor(journal: Journal, tmp_path: Path) -> None:
    older = copy_files(journal, anchor=False)
    journal.append([entry(10)])
    restore_files(journal, older)
    found = check(journal)
    assert (found["head"], found["ok"]) == ("older", False)
    signed_journal(tmp_path).append([entry(11)])
    assert not check(journal)["ok"]


def test_head_of_before_a_rotation_with_the_size_of_the_current_file_is_older(tmp_path: Path) -> None:
    journal = signed_journal(tmp_path, max_bytes=900)
    journal.append([entry(0)])
    older = head_file(journal).read_bytes()
    size = journal.path.stat().st_size
    number = 0
    while number < 4 or journal.path.stat().st_size != size:
        number = (number + 1) % 10
        journal.append([entry(number)])
    head_file(journal).write_bytes(older)
    found = check(journal)
    assert (found["head"], found["ok"]) == ("older", False)


@pytest.mark.parametrize("more", [0, 2, 40])
def test_rotated_file_that_was_renamed_is_found(tmp_path: Path, more: int) -> None:
    journal = signed_journal(tmp_path, max_bytes=900)
    while len(journal.files()) < 3:
        journal.append([entry(0)])
    oldest = journal.files()[0]
    oldest.rename(oldest.with_name(f"{journal.path.name}.4"))
    for number in range(more):
        journal.append([entry(number)])
    assert not check(journal)["ok"]


def test_running_writer_remembers_what_was_rolled_back_with_its_anchor(journal: Journal, tmp_path: Path) -> None:
    older = copy_files(journal, anchor=True)
    journal.append([entry(10)])
    restore_files(journal, older)
    assert check(journal)["ok"], "nothing on this machine's disk remembers it"
    journal.append([entry(11)])
    assert not check(journal)["ok"]
    assert any("rolled back" in each["why"] for each in check(journal)["breaks"])


def test_an_audit_that_was_deleted_whole_is_no_intact_one(journal: Journal) -> None:
    shutil.rmtree(journal.directory)
    found = check(journal)
    assert (found["total"], found["head"], found["ok"]) == (0, "missing", False)


def test_log_of_another_directory_with_the_same_secret_is_refused(journal: Journal, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(journal.directory, other)
    assert not verify(signed_journal(other), keyed=True)["ok"]


def test_without_a_secret_a_cut_is_recorded_and_found_too(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    for number in range(6):
        journal.append([entry(number)])
    cut_the_tail(journal)
    Journal(tmp_path).append([entry(10)])
    found = verify(Journal(tmp_path), keyed=False)
    assert (found["tampered"], found["ok"]) == (1, False)


@pytest.mark.parametrize("step", range(1, 30))
@pytest.mark.parametrize("max_bytes", [10**9, 900], ids=["one file", "rotation"])
def test_writer_that_dies_at_any_step_is_no_tampering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, max_bytes: int
) -> None:
    """Each step is a system call that changes a file, and a write may end in its middle."""
    journal = signed_journal(tmp_path, max_bytes=max_bytes)
    acknowledged = 0
    for acknowledged in range(24):
        journal.append([entry(acknowledged)])
    with dying_after(step, monkeypatch):
        for acknowledged in range(24, 40):
            journal.append([entry(acknowledged)])
    assert check(journal)["ok"], check(journal)
    survivor = signed_journal(tmp_path, max_bytes=max_bytes)
    survivor.append([entry(99)])
    found = check(journal)
    assert found["ok"], found
    numbers = [each["payload"]["n"] for each in journal.records()]
    assert numbers[-1] == 99
    assert numbers[:-1] == list(range(numbers[0], numbers[-2] + 1))
    assert numbers[-2] >= acknowledged - 1


def test_head_holds_no_more_than_twenty_breaks(journal: Journal) -> None:
    for number in range(25):
        cut_the_tail(journal)
        journal.append([entry(number)])
    assert isinstance(journal.written, Head)
    assert len(journal.written.breaks) == 20
