"""``dashboard``: which networks its page has."""

from __future__ import annotations

import os

import pytest
from tests.cli.conftest import Run

from strands_robots import settings
from strands_robots.cli.dashboard import example
from strands_robots.cli.output import Exit, Screen


def test_demo_and_its_robots_keep_off_the_mesh_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    # Its settings are for the robots that it starts, too; monkeypatch puts back all of them.
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setenv("STRANDS_MESH", "true")
    with example("page").page_robots(Screen(machine=True)):
        assert settings.raw("STRANDS_MESH") == os.environ["STRANDS_MESH"] == "false"


@pytest.mark.parametrize(("flags", "why"), [(("--mesh",), "STRANDS_MESH"), (("--mesh", "--demo"), "of its own")])
def test_mesh_that_cannot_be_had_is_wrong_usage(
    run: Run, monkeypatch: pytest.MonkeyPatch, flags: tuple[str, ...], why: str
) -> None:
    monkeypatch.setenv("STRANDS_MESH", "false")
    result = run("dashboard", "--no-browser", *flags)
    assert (result.exit_code, why in result.output) == (Exit.USAGE, True), result.output
