"""A leader that is kept inside its follower's bounds before its frames are sent."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from strands_robots.teleoperators import BoundedLeader, LeaderFinished, LeaderPolicy
from strands_robots.utils import ValidationError

RANGES = {"pan.pos": (-100.0, 100.0)}


class Leader:
    def __init__(self, get_action: Callable[[], Any]) -> None:
        self.get_action = get_action


def bounded(get_action: Callable[[], Any], now: Callable[[], float] = time.monotonic) -> BoundedLeader:
    return BoundedLeader(
        LeaderPolicy(Leader(get_action), max_speed=1.0, period=0.02, now=now), {"pan.pos": 0.0}, RANGES
    )


def test_first_frames_approach_from_the_followers_position() -> None:
    leader = bounded(lambda: {"pan.pos": 90.0}, now=lambda: 5.0)
    # One range of 200 a second, at most, in periods of 20 ms.
    assert [leader.get_action()["pan.pos"] for _ in range(3)] == pytest.approx([4.0, 8.0, 12.0])


def test_unknown_key_makes_a_frame_unusable_without_ending_the_leader() -> None:
    leader = bounded(lambda: {"elbow.pos": 1.0}, now=lambda: 5.0)
    with pytest.raises(ValidationError, match=r"elbow\.pos"):
        leader.get_action()
    assert not leader.done.is_set()


def test_last_frame_is_repeated_after_the_end() -> None:
    def get_action() -> dict[str, float]:
        if given:
            raise LeaderFinished("over")
        given.append(1)
        return {"pan.pos": 1.0}

    given: list[int] = []
    leader = bounded(get_action)
    first = leader.get_action()
    assert leader.get_action() == first
    assert leader.done.is_set()
    assert leader.error == ""
    assert leader.get_action() == first


def test_leader_that_fails_for_long_ends_with_its_reason() -> None:
    def get_action() -> dict[str, float]:
        raise ConnectionError("unplugged")

    clock = iter([0.0, 0.1, 1.0])
    leader = bounded(get_action, now=lambda: next(clock))
    with pytest.raises(ValidationError, match="unplugged"):
        leader.get_action()
    with pytest.raises(ValidationError, match="before its first frame"):
        leader.get_action()
    assert leader.done.is_set()
    assert "unplugged" in leader.error


def test_failed_read_of_events_is_raised_to_the_caller() -> None:
    class Pad(Leader):
        def get_teleop_events(self) -> dict[str, bool]:
            raise OSError("no events")

    leader = BoundedLeader(LeaderPolicy(Pad(dict)), {"pan.pos": 0.0}, RANGES)
    with pytest.raises(OSError, match="no events"):
        leader.get_teleop_events()
