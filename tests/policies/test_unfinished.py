"""End of a process while a policy computes: it waits a little, names what hangs, and keeps its exit code."""

from __future__ import annotations

import pytest
from fixtures.ending import NAMED, ended


@pytest.mark.parametrize(("end", "code"), [("", 0), ("sys.exit(3)", 3), ("raise SystemExit(4)", 4)])
def test_an_inference_that_hangs_is_named_and_the_exit_code_is_kept(end: str, code: int) -> None:
    process = ended("threading.Event().wait()", end)
    assert NAMED.fullmatch(process.stderr), process.stderr
    assert process.returncode == code


def test_an_inference_that_ends_soon_is_waited_for_and_not_named() -> None:
    # It goes on when the end has begun to wait for it.
    process = ended("preload._ending.wait(); print('done', flush=True)", "sys.exit(3)", ending_s=60, torch=True)
    assert (process.stdout, process.stderr, process.returncode) == ("done\n", "", 3)


def test_an_inference_without_torch_is_not_waited_for() -> None:
    process = ended("threading.Event().wait()", "", ending_s=1000)
    assert NAMED.fullmatch(process.stderr), process.stderr


def test_no_inference_begins_once_the_process_ends() -> None:
    again = "preload._ending.wait(); worker.ask('two'); begun.clear()"
    process = ended(again, "sys.exit(3)", ending_s=60, torch=True)
    assert (process.stderr, process.returncode) == ("", 3)


def test_a_command_that_leaves_names_what_hangs_too() -> None:
    process = ended("threading.Event().wait()", "from strands_robots.cli import _leave; _leave(3)")
    assert NAMED.fullmatch(process.stderr), process.stderr
    assert process.returncode == 3
