from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from click.testing import Result

from strands_robots.audit import flush_audit, log_safety_event

Run = Callable[..., Result]
EPOCH = "0123456789abcdef0123456789abcdef"


def record(count: int = 3) -> None:
    for number in range(count):
        log_safety_event("emergency_stop", "arm-1", {"epoch": EPOCH, "number": number})
    log_safety_event("resume_local", "arm-2", {"who": "ada\x1b[2J", "epochs": [EPOCH]})
    assert flush_audit(20)


def test_the_tail_is_the_last_records_and_no_control_sequence(run: Run) -> None:
    record()
    shown = run("audit", "tail")
    assert shown.exit_code == 0
    assert "arm-1" in shown.stdout and "resume_local" in shown.stdout
    assert "\x1b" not in shown.stdout
    told = [json.loads(line) for line in run("audit", "tail", "-n", "2", "--json").stdout.splitlines()]
    assert [each["event"] for each in told] == ["emergency_stop", "resume_local"]


def test_an_empty_record_is_no_failure_of_the_tail(run: Run) -> None:
    assert run("audit", "tail").exit_code == 0
    assert run("audit", "tail", "-n", "0").exit_code == 2


def test_records_are_shown_by_stop_robot_and_event(run: Run) -> None:
    record()

    def many(*words: str) -> int:
        return len(run("audit", "show", *words, "--json").stdout.splitlines())

    assert many(EPOCH) == 4
    assert many("arm-2") == 1
    assert many("emergency_stop") == 3
    assert many("--last", "60") == 4
    assert run("audit", "show", "arm-9").exit_code == 1


def test_a_record_that_was_changed_fails_its_check(run: Run, state_directory: Path) -> None:
    record()
    assert run("audit", "verify").exit_code == 0
    log = next(path for path in state_directory.iterdir() if path.suffix == ".jsonl")
    log.write_bytes(log.read_bytes().replace(b'"number":1', b'"number":7'))
    result = run("audit", "verify", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["broken"] == 1
