"""The mock policy: smooth, bounded, the same every time."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from strands_robots.policies.base import MockPolicy, Ranges
from strands_robots.utils import ValidationError

ARM: Ranges = {"pan": (-1.5, 2.0), "lift": (0.0, 3.0), "grip": (-0.2, 1.7)}


def motion(
    steps: int, instruction: str = "wave", start: dict[str, float] | None = None, **options: float
) -> list[dict[str, float]]:
    policy = MockPolicy(**options)  # type: ignore[arg-type]
    policy.reset(instruction, ARM)
    return [policy.act(start or {"pan": 0.3, "lift": 1.0, "grip": 0.0}) for _ in range(steps)]


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(-1000, 1000),
    instruction=st.text(max_size=20),
    amplitude=st.floats(0.01, 1.0),
    pan=st.floats(-1.5, 2.0),
)
def test_motion_stays_inside_every_range(seed: int, instruction: str, amplitude: float, pan: float) -> None:
    for action in motion(400, instruction, {"pan": pan, "lift": 0.0, "grip": 1.7}, seed=seed, amplitude=amplitude):
        for key, (low, high) in ARM.items():
            assert low - 1e-9 <= action[key] <= high + 1e-9


def test_motion_starts_at_the_present_position_without_velocity() -> None:
    first = motion(3)
    assert first[0] == pytest.approx({"pan": 0.3, "lift": 1.0, "grip": 0.0})
    for key in ARM:
        assert abs(first[1][key] - first[0][key]) < 1e-4


def test_motion_is_smooth() -> None:
    actions = motion(1000)
    for key, (low, high) in ARM.items():
        speeds = [(b[key] - a[key]) * 50 for a, b in itertools.pairwise(actions)]
        jumps = [abs(b - a) for a, b in itertools.pairwise(speeds)]
        assert max(map(abs, speeds)) < 2 * (high - low)
        assert max(jumps) < 0.25 * (high - low)


def test_every_joint_moves() -> None:
    actions = motion(500)
    for key, (low, high) in ARM.items():
        assert max(a[key] for a in actions) - min(a[key] for a in actions) > 0.2 * (high - low)


def test_motion_depends_only_on_seed_and_instruction() -> None:
    assert motion(200) == motion(200)
    assert motion(200) != motion(200, seed=1)
    assert motion(200) != motion(200, "pick up the cube")


def test_joint_without_range_does_not_move_and_a_body_without_ranges_is_refused() -> None:
    policy = MockPolicy()
    policy.reset("wave", {"pan": (-1.0, 1.0), "lift": (-math.inf, math.inf)})
    assert set(policy.act({"pan": 0.0, "lift": 0.0})) == {"pan"}
    with pytest.raises(ValidationError, match="finite range"):
        policy.reset("wave", {"lift": (-math.inf, math.inf)})
