"""A runner for commands, away from the user's own settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from strands_robots import settings
from strands_robots.cli.app import build

Run = Callable[..., Result]


@pytest.fixture(autouse=True)
def own_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for setting in settings.declared():
        monkeypatch.delenv(setting.name, raising=False)
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path / "state"))


@pytest.fixture
def run() -> Run:
    """Run a command line, as ``run("doctor", "--json")``."""

    def call(*words: str) -> Result:
        return CliRunner().invoke(build(), list(words))

    return call
