"""Progress of an attempt: what a person at the terminal, a log and a program are told."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.waiting import eventually
from rich.console import Console

from strands_robots.cli import attempt_progress
from strands_robots.cli.attempt_progress import AttemptProgress
from strands_robots.cli.output import Screen
from strands_robots.recording.file import STEP, Recorder


@pytest.fixture
def progress(tmp_path: Path) -> Any:
    """Progress of an attempt of two seconds, whose last step came half a second ago, and whose picture is older."""
    encoder: Any = SimpleNamespace(dropped={"top": 3}, offer=lambda camera, picture, at: True)
    with Recorder(tmp_path / "attempt.mcap") as recorder:
        made = AttemptProgress(recorder, 30, encoder)
        now = time.time()
        for at in (now - 2.5, now - 1.5, now - 0.5):
            recorder.take("arm", STEP, {}, at)
        made.take_picture("top", b"", now - 0.8)
        eventually(lambda: recorder.counts["/arm/streamStep"] == 3, within=5)
        yield made


def test_figures_are_those_of_the_readings(progress: AttemptProgress) -> None:
    row = progress.row()
    assert row["frames"] == 61
    assert 500 <= row["age_ms"]["state"] < 700 < row["age_ms"]["top"] < 1000
    assert (row["dropped"], row["lost"]) == ({"top": 3}, 0)
    assert row["lag_ms"] >= 500, "it was written half a second after its moment"
    assert "61 frames" in progress.line()
    assert "dropped top 3" in progress.line()


def test_terminal_has_one_line_that_is_drawn_over(progress: AttemptProgress, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempt_progress, "LIVE_S", 0.01)
    file = io.StringIO()
    with progress.shown(Screen(console=Console(file=file, force_terminal=True, width=40))):
        eventually(lambda: file.getvalue().count("\r") > 2, within=5)
    *lines, last = file.getvalue().removesuffix("\r").split("\r")
    assert {len(line) for line in lines} == {39}, "shorter than the terminal is wide"
    assert (last.strip(), "\n" in file.getvalue(), "frames" in lines[0]) == ("", False, True)


def test_log_and_program_get_a_line_now_and_then(
    progress: AttemptProgress, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(attempt_progress, "PLAIN_S", 0.01)
    file = io.StringIO()
    with progress.shown(Screen(console=Console(file=file, width=200))):
        eventually(lambda: file.getvalue().count("\n") > 1, within=5)
    assert "\r" not in file.getvalue()
    with progress.shown(Screen(machine=True)):
        time_over = time.monotonic() + 5
        while not (told := capsys.readouterr().out):
            assert time.monotonic() < time_over
    row = json.loads(told.splitlines()[0])
    assert (row["event"], row["frames"]) == ("progress", 61)
