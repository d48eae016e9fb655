"""A forked program is to a test what a started one is; only its imports were made before."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.child import ROOT, Child
from fixtures.forked import NETWORKS, Forked, start, starting
from fixtures.waiting import eventually, signalled

LINE = (sys.executable, "-m", "fixtures.reporting_process")
PIPES: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}

Start = Callable[..., subprocess.Popen[Any]]


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[Any]]]:
    started: list[subprocess.Popen[Any]] = []
    yield started
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture(params=[subprocess.Popen, start], ids=["started", "forked"])
def begin(request: pytest.FixtureRequest, processes: list[subprocess.Popen[Any]]) -> Start:
    def begun(*arguments: str, **options: Any) -> subprocess.Popen[Any]:
        process: subprocess.Popen[Any] = request.param([*LINE, *arguments], **{"cwd": ROOT, **PIPES, **options})
        processes.append(process)
        return process

    return begun


def report(process: subprocess.Popen[Any]) -> dict[str, Any]:
    assert process.stdout is not None
    return dict(json.loads(process.stdout.readline()))


def test_program_has_its_own_arguments_environment_and_folder(
    begin: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kept = {name: value for name, value in os.environ.items() if name.startswith(("PYTHON", "LD_"))}
    environment = {**kept, "VARIABLE": "a", "LC_ALL": "C.UTF-8"}
    said = report(begin("one", "two words", env=environment, cwd=ROOT))
    assert said["arguments"] == ["one", "two words"]
    assert said["variables"] == environment
    assert said["folder"] == str(ROOT)


def test_program_is_a_child_of_the_test_in_its_process_group(begin: Start) -> None:
    process = begin()
    said = report(process)
    assert said["parent"] == os.getpid()
    assert said["group"] == os.getpgid(0)
    assert said["session"] == os.getsid(0)


def test_program_may_have_a_session_of_its_own(begin: Start) -> None:
    process = begin(start_new_session=True)
    said = report(process)
    assert said["session"] == said["group"] == process.pid


def test_program_holds_no_file_but_its_three(begin: Start) -> None:
    said = report(begin())
    assert said["files"] == [0, 1, 2]
    assert said["threads"] == 1


@pytest.mark.parametrize(("word", "code"), [("0", 0), ("3", 3), ("raise", 1)])
def test_program_ends_with_its_exit_code(begin: Start, word: str, code: int) -> None:
    process = begin()
    report(process)
    out, err = process.communicate(word)
    assert process.returncode == code
    assert out == ""
    assert err.startswith("ends\n")
    assert ("RuntimeError: raise" in err) is (word == "raise")


def test_standard_error_may_be_that_of_the_output(begin: Start) -> None:
    process = begin(stderr=subprocess.STDOUT)
    report(process)
    assert process.communicate("0")[0] == "ends\n"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_signal_ends_the_program_alone(begin: Start, number: signal.Signals) -> None:
    process, other = begin(), begin()
    report(process)
    report(other)
    process.send_signal(number)
    assert process.wait(20) == -number
    assert other.poll() is None
    other.communicate("0")
    assert other.returncode == 0


def test_program_may_be_stopped_and_continued(begin: Start) -> None:
    process = begin()
    report(process)
    signalled(process, signal.SIGSTOP)
    assert Path(f"/proc/{process.pid}/stat").read_text().split()[2] == "T"
    signalled(process, signal.SIGCONT)
    process.communicate("0")
    assert process.returncode == 0


def test_two_forks_draw_different_numbers() -> None:
    forks = [Forked([*LINE], NETWORKS, **PIPES) for _ in range(2)]
    assert len({report(each)["random"] for each in forks}) == 2
    for each in forks:
        each.communicate("0")


def test_forked_program_finds_the_networks_imported() -> None:
    with start(LINE, **PIPES) as process:
        assert report(process)["network"] is True
        process.communicate("0")
    with start(LINE, imports=(), **PIPES) as process:
        assert report(process)["network"] is False
        process.communicate("0")


@pytest.mark.parametrize("variable", ["PYTHONPATH", "LD_LIBRARY_PATH"])
def test_other_paths_are_those_of_a_started_program(variable: str) -> None:
    process = start(LINE, env={**os.environ, variable: str(ROOT)}, **PIPES)
    assert not isinstance(process, Forked)
    process.communicate("0")


async def test_what_a_library_starts_in_a_block_is_forked() -> None:
    with starting(NETWORKS):
        process = await asyncio.create_subprocess_exec(
            *LINE, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT, start_new_session=True
        )
    out, _ = await process.communicate(b"7\n")
    assert json.loads(out)["network"] is True
    assert process.returncode == 7


def test_program_that_does_not_exist_has_ended() -> None:
    with pytest.raises(RuntimeError, match="ended"):
        Child("fixtures.no_such_program", {})


def test_orphans_of_the_tests_are_not_adopted() -> None:
    with start(LINE, **PIPES) as process:
        report(process)
        process.communicate("0")
    sleeper = "import os, sys, time; os.fork() or (print(os.getppid(), flush=True), time.sleep(600))"
    with subprocess.Popen([sys.executable, "-c", sleeper], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert int(parent.stdout.readline()) == parent.pid
        orphans = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
        assert len(orphans) == 1
        parent.kill()
        parent.wait()
        try:
            status = Path(f"/proc/{orphans[0]}/status")
            eventually(lambda: f"PPid:\t{parent.pid}\n" not in status.read_text())
            assert f"PPid:\t{os.getpid()}\n" not in status.read_text()
        finally:
            os.kill(int(orphans[0]), signal.SIGKILL)
