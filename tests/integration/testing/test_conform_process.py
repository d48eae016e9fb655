"""``conform`` checks in a process of its own: what hangs, crashes or ends it is a failed check, and nothing is left."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fixtures.command_line import COMMAND, WITHIN_S, Machine

from strands_robots.cli import conform_process
from strands_robots.cli.conform_process import ConformRequest, conform_apart
from strands_robots.cli.output import CliError, Exit
from strands_robots.testing import CheckMark, ConformanceReport

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.system

BEGINS = """
import json, os, signal, sys, time
request = json.loads(sys.stdin.readline())
def tell(**event): print(json.dumps(event), flush=True)
def kept(check): tell(event="result", check=check, tier="BRONZE", mark="passed", said="", promise="", why="", look="")
tell(event="checking", check="bronze.made")
tell(event="made", robot="rig")
kept("bronze.made")
"""
VERBS = "tell(event='checking', check='bronze.verbs')"
HALTS = "sys.stdin.read(); tell(event='halted', stopped=True, said='It stands.'); os._exit(130)"


def checked(monkeypatch: pytest.MonkeyPatch, then: str, limit_s: float = 20.0) -> ConformanceReport:
    """Return the report of a process that begins well, and does this then."""
    monkeypatch.setattr(conform_process, "PROGRAM", (sys.executable, "-c", BEGINS + then))
    only = ("bronze.made", "bronze.verbs", "bronze.reads")
    return conform_apart(ConformRequest("rig", {}, "BRONZE", only, limit_s=limit_s), lambda result: None)


@pytest.mark.parametrize(
    ("then", "check", "said"),
    [
        (f"{VERBS}; os.kill(os.getpid(), signal.SIGSEGV)", "bronze.verbs", "died of SIGSEGV in bronze.verbs"),
        (f"{VERBS}; os._exit(0)", "bronze.verbs", "ended itself with 0 in"),
        ("os._exit(7)", "bronze.verbs", "ended itself with 7 in the halt after bronze.made"),
    ],
    ids=["crashes", "exits", "exits at rest"],
)
def test_process_that_dies_fails_the_check_under_way(
    monkeypatch: pytest.MonkeyPatch, then: str, check: str, said: str
) -> None:
    report = checked(monkeypatch, then)
    (failed,) = report.failed
    assert (failed.check, report.name) == (check, "rig")
    assert said in failed.said
    last = report.results[-1]
    assert (last.check, last.mark, last.waits_for) == ("bronze.reads", CheckMark.NOT_PROVEN, check)


def test_check_beyond_the_limit_fails_once_the_robot_is_halted(monkeypatch: pytest.MonkeyPatch) -> None:
    (failed,) = checked(monkeypatch, f"{VERBS}; {HALTS}", limit_s=1.0).failed
    assert failed.check == "bronze.verbs"
    assert "Its halt said: It stands. No answer came for 1 s" in failed.said


def test_process_that_holds_the_interpreter_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conform_process, "ENDS_WITHIN_S", 0.5)
    (failed,) = checked(monkeypatch, "time.sleep(1000)", limit_s=1.0).failed
    assert "It could not be halted." in failed.said


def test_process_that_crashes_when_it_lets_go_has_not_kept_its_first_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    then = "kept('bronze.verbs'); kept('bronze.reads'); tell(event='end', robot='rig'); os.kill(os.getpid(), 11)"
    report = checked(monkeypatch, then)
    assert [each.check for each in report.failed] == ["bronze.made"]
    assert "SIGSEGV when it was put away" in report.failed[0].said


def test_process_that_a_thread_of_the_robot_keeps_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conform_process, "ENDS_WITHIN_S", 0.5)
    report = checked(monkeypatch, "kept('bronze.verbs'); tell(event='end', robot='rig'); time.sleep(1000)")
    assert not report.failed


def test_refused_robot_is_a_failure_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CliError, match="no such robot") as refused:
        checked(monkeypatch, "tell(event='refused', reason='no such robot', exit=2)")
    assert refused.value.code is Exit.USAGE


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    folder = tmp_path / "tmp"
    folder.mkdir()
    return folder


@contextmanager
def conforming(temporary: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``conform`` on a machine of its own."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    machine = Machine(temporary.parent / "state", PYTHONPATH=path, TMPDIR=str(temporary))
    process = subprocess.Popen(
        [*COMMAND, "conform", *arguments, "--json"],
        env=machine.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=WITHIN_S)


def test_robot_whose_stop_crashes_fails_by_name_and_leaves_nothing(temporary: Path) -> None:
    with conforming(temporary, "fixtures.crashing_robots:crashes", "--only", "silver.halts") as command:
        out, _ = command.communicate(timeout=WITHIN_S)
    events = [json.loads(line) for line in out.splitlines()]
    assert (command.returncode, events[-1]["exit"]) == (1, 1)
    (result,) = events[-2]["checks"]
    assert (result["check"], result["mark"]) == ("silver.halts", "failed")
    assert result["said"] == "the process died of SIGSEGV in silver.halts."
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "killed"])
def test_command_that_ends_early_halts_the_robot_and_leaves_nothing(temporary: Path, number: signal.Signals) -> None:
    with conforming(temporary, "fixtures.crashing_robots:waits", "--only", "bronze.reads") as command:
        assert command.stderr is not None
        assert any("reading" in line for line in command.stderr)
        command.send_signal(number)
        command.wait(WITHIN_S)
        # The end of the errors is the end of both processes.
        assert "halting" in command.stderr.read()
        assert command.stdout is not None
        out = command.stdout.read()
    assert list(temporary.iterdir()) == []
    if number is signal.SIGINT:
        assert command.returncode == 130
        # The command may not have taken the last event yet.
        assert re.match(r"Interrupted in bronze\.(made|reads)\. Its halt said: ", json.loads(out)["reason"])


def test_no_folder_of_the_checks_is_left_here(monkeypatch: pytest.MonkeyPatch, temporary: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    checked(monkeypatch, "open(request['folder'] + '/sightings.db', 'w').close(); os._exit(1)")
    assert list(temporary.iterdir()) == []
