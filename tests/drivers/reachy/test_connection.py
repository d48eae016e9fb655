"""Feed of the daemon's messages."""

from __future__ import annotations

import math

import pytest

from strands_robots.bounded_json import SMALL_BYTES
from strands_robots.drivers.reachy import connection
from strands_robots.drivers.reachy.connection import Feed


@pytest.mark.parametrize(
    "frame",
    [
        "{bad",
        "[]",
        '{"head_joint_positions":[0,0,0,0,0,0,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0],"antennas_joint_positions":[0,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0,null],"antennas_joint_positions":[0,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0,0],"antennas_joint_positions":[NaN,0]}',
        '{"head_joint_positions":[0,0,0,0,0,0,true],"antennas_joint_positions":[0,0]}',
    ],
)
def test_joint_frame_without_nine_numbers_is_dropped_and_counted_and_shows_life(
    frame: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "FRESH_S", 60.0)
    feed = Feed()
    feed.take("joint_positions", frame)
    assert (feed.joints, feed.unusable_frames, feed.alive) == (None, 1, True)


def test_feed_is_not_alive_before_its_first_frame() -> None:
    assert Feed().silent_s == math.inf
    assert not Feed().alive


def test_a_message_beyond_the_bound_is_dropped_unparsed() -> None:
    feed = Feed()
    for kind in ("joint_positions", "head_pose", "daemon_status"):
        feed.take(kind, "[" * (SMALL_BYTES + 1))
    assert (feed.joints, feed.pose(), feed.status(), feed.unusable_frames) == (None, None, None, 3)
