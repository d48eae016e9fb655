"""A leader whose frames travel is kept inside its follower's bounds first."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from strands_robots.teleoperators.leader import BoundedLeader, LeaderFinished, LeaderPolicy
from strands_robots.utils import ValidationError

RANGES = {"pan.pos": (-100.0, 100.0)}


class Leader:
    def __init__(self, gives: Callable[[], Any]) -> None:
        self.get_action = gives


def bounded(gives: Callable[[], Any], now: Callable[[], float] = time.monotonic) -> BoundedLeader:
    return BoundedLeader(LeaderPolicy(Leader(gives), max_speed=1.0, period=0.02, now=now), {"pan.pos": 0.0}, RANGES)


def test_the_first_frames_glide_from_where_the_follower_stands() -> None:
    leader = bounded(lambda: {"pan.pos": 90.0}, now=lambda: 5.0)
    # One range of 200 a second, at most, in periods of 20 ms.
    assert [leader.get_action()["pan.pos"] for _ in range(3)] == pytest.approx([4.0, 8.0, 12.0])


def test_targets_are_clamped_and_keys_that_the_follower_has_not_are_counted_unusable() -> None:
    leader = bounded(lambda: {"elbow.pos": 1.0}, now=lambda: 5.0)
    with pytest.raises(ValidationError, match=r"elbow\.pos"):
        leader.get_action()
    assert not leader.done.is_set()


def test_after_the_end_the_last_frame_is_held() -> None:
    def gives() -> dict[str, float]:
        if gave:
            raise LeaderFinished("over")
        gave.append(1)
        return {"pan.pos": 1.0}

    gave: list[int] = []
    leader = bounded(gives)
    first = leader.get_action()
    assert leader.get_action() == first
    assert leader.done.is_set()
    assert leader.error == ""
    assert leader.get_action() == first


def test_a_leader_that_fails_for_long_is_given_up_with_its_reason() -> None:
    def gives() -> dict[str, float]:
        raise ConnectionError("unplugged")

    clock = iter([0.0, 0.1, 1.0])
    leader = bounded(gives, now=lambda: next(clock))
    with pytest.raises(ValidationError, match="unplugged"):
        leader.get_action()
    with pytest.raises(ValidationError, match="before its first frame"):
        leader.get_action()
    assert leader.done.is_set()
    assert "unplugged" in leader.error


def test_a_failed_reading_of_its_events_is_told_to_who_counts_it() -> None:
    class Pad(Leader):
        def get_teleop_events(self) -> dict[str, bool]:
            raise OSError("no events")

    leader = BoundedLeader(LeaderPolicy(Pad(dict)), {"pan.pos": 0.0}, RANGES)
    with pytest.raises(OSError, match="no events"):
        leader.get_teleop_events()
