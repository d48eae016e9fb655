"""``eval``: success rates, recordings and plot."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from strands_robots.policies.base import MockPolicy

Run = Callable[..., Result]


def test_the_command_prints_the_rates_and_keeps_a_recording_of_each_episode(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    arguments = ("eval", "--policy", "expert:reach", "--policy", "mock", "--task", "reach", "--episodes", "2")
    result = run(*arguments, "--output", str(folder), "--json")
    assert result.exit_code == 0, result.output
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert [(each["policy"], each["success"]) for each in found] == [("expert:reach", True)] * 2 + [("mock", False)] * 2
    assert sorted(path.name for path in folder.rglob("*.mcap")) == ["0000.mcap", "0000.mcap", "0001.mcap", "0001.mcap"]
    assert (folder / "success.svg").exists()
    again = run(*arguments, "--output", str(folder))
    assert again.exit_code == 2
    assert "must be a new folder" in again.output + again.stderr


def test_a_failing_policy_is_told_with_exit_code_1(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(policy: MockPolicy, observation: object) -> None:
        raise OSError("no GPU")

    monkeypatch.setattr(MockPolicy, "act", lost)
    result = run("eval", "--policy", "mock", "--task", "reach", "--episodes", "1", "--output", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "mock failed: OSError: no GPU" in result.output + result.stderr
