"""Policy steps of a peer on the wire, and the limit on their rate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh.state import numbers


def test_policy_steps_carry_numbers_and_are_thinned_out(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_STREAM_HZ", "0.005")
    # One in 200 s, and a second one after half of that at the soonest: no machine is slow enough for two.
    one, two = peers.join(Arm(), "arm-1"), peers.join(None, "console")
    steps: list[dict[str, Any]] = []
    two.on_stream("arm-1", lambda key, data: steps.append(data))
    observation = {"j": 1.5, "image": np.zeros((4, 4)), "near": np.arange(3.0), "far": [0.0] * 100, "nan": float("nan")}
    for number in range(50):
        one.publish_step(number, observation, {"j": 2}, "wave", "mock")
    eventually(lambda: steps)
    assert steps[0]["observation"] == {"j": 1.5, "near": [0.0, 1.0, 2.0]}
    assert steps[0]["instruction"] == "wave"
    assert len(steps) == 1


def test_numbers_leaves_out_what_is_none() -> None:
    assert numbers({"a": True, "b": "x", "c": None, 3: 1}) == {"a": True, "3": 1}
