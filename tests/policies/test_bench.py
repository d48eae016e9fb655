"""``policy bench``: the loop of a profile on a body that stands still."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.checkpoints import write_dataset

from strands_robots import policies
from strands_robots.policies.base import PolicyError
from strands_robots.policies.bench import StillBody, measure
from strands_robots.policies.profiles import Profile, load_profiles

KEYS = ["pan", "lift"]


class Slow:
    """Answers with ten steps after ``latency_s``."""

    uses_cameras = False
    latency_s = 0.02

    def reset(self, instruction: str, ranges: Any) -> None: ...

    def act(self, observation: Mapping[str, Any]) -> Any:
        assert set(observation) >= set(KEYS)
        time.sleep(self.latency_s)
        return [dict.fromkeys(KEYS, 0.0)] * 10

    def interrupt(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture
def profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Profile:
    file = tmp_path / "policies.toml"
    file.write_text(
        f'[slow]\nprovider = "remote"\nurl = "ws://localhost:9"\nstate = {json.dumps(KEYS)}\n'
        f'action = {json.dumps(KEYS)}\nunits = "radians"\nrate = 50\nhorizon = 10\ndeadline_s = 5.0\n'
        '[slow.cameras.front]\nkey = "front"\nsize = [8, 8]\n'
    )
    monkeypatch.setenv("STRANDS_POLICIES", str(file))
    monkeypatch.setattr(policies, "policy_factory", lambda name: Slow)
    return load_profiles(file)["slow"]


def test_the_figures_of_a_policy_that_is_fast_enough(profile: Profile) -> None:
    found = measure(profile, 50.0, 1.0)
    rows = {row.what.split(",")[0]: row for row in found.rows}
    assert rows["latency"].kept
    assert rows["latency"].budget == "200 ms, the steps that are played"
    assert found.loop["inferences"] >= 4
    assert found.loop["latency_p50_ms"] >= 20


def test_the_body_stands_in_the_middle_of_the_data(profile: Profile, tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", KEYS, low=10.0, high=30.0)
    assert StillBody(replace(profile, dataset=str(data))).get_joints() == dict.fromkeys(KEYS, 20.0)


def test_a_policy_slower_than_its_steps_misses_its_budget(profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Slow, "latency_s", 0.4)
    found = measure(profile, 50.0, 1.5)
    rows = {row.what.split(",")[0]: row for row in found.rows}
    assert not rows["latency"].kept
    assert not rows["underruns"].kept
    assert not found.kept


def test_a_policy_that_fails_is_told(profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Slow, observation: object) -> Any:
        raise OSError("no GPU")

    monkeypatch.setattr(Slow, "act", fail)
    with pytest.raises(PolicyError, match="no GPU"):
        measure(profile, 50.0, 1.0)
