"""A runner for commands, away from the user's own settings."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from click.testing import Result
from typer.testing import CliRunner

from strands_robots.cli.app import build

Run = Callable[..., Result]


@pytest.fixture
def run() -> Run:
    """Run a command line, as ``run("doctor", "--json")``."""

    def call(*words: str) -> Result:
        return CliRunner().invoke(build(), list(words))

    return call
