from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from strands_robots.safety.approval import Grants

Run = Callable[..., Result]


def test_a_grant_can_be_claimed_once(run: Run, state_directory: Path) -> None:
    result = run("grant", "execute@arm-1", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["peer"] == "arm-1"
    grants = Grants(state_directory / "grants")
    assert grants.claim("execute", "arm-1") is not None
    assert grants.claim("execute", "arm-1") is None


@pytest.mark.parametrize("what", ["execute", "@arm-1", "execute@", "exe cute@arm-1", "execute@arm/1"])
def test_anything_but_verb_at_peer_is_wrong_usage(run: Run, what: str) -> None:
    result = run("grant", what)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "1e9"])
def test_a_grant_lasts_a_sensible_time(run: Run, seconds: str) -> None:
    assert run("grant", "execute@arm-1", "--for", seconds).exit_code == 2
