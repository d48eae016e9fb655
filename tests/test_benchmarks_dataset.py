"""Arithmetic of the table of datasets: what is a miss, and what is measured of a kill."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.dataset import beat_row, kills_row, stops_row, writer_rows
from benchmarks.dataset_children import RecordedArm
from benchmarks.dataset_train import paired_interval, train_row
from benchmarks.dataset_writers import device
from fixtures.killed_recorders import Kill, missing_s
from fixtures.replayed_cameras import ReplayedCamera, stamp, stamped

from strands_robots.datasets.layout import read_info
from strands_robots.hardware import HardwareRobot

EACH = [Kill("recorder", 0.2, ""), Kill("encoder", None, ""), Kill("robot", 0.9, "")]


@pytest.mark.parametrize(
    ("kills", "lost", "kept"),
    [
        (EACH, [], True),
        (EACH, ["episode 3"], False),
        ([*EACH, Kill("recorder", 1.1, "")], [], False),
        (EACH[:1] * 3, [], False),
        ([*EACH, Kill("recorder", None, "", 0.3)], [], True),
        ([*EACH, Kill("recorder", None, "", 0.31)], [], False),
    ],
    ids=["all is well", "one is lost", "cut too short", "a part was never killed", "halted", "halted too late"],
)
def test_kills_keep_their_bound_where_nothing_is_lost(kills: list[Kill], lost: list[str], kept: bool) -> None:
    assert kills_row(kills, 5, lost, 5).ok is kept


@pytest.mark.parametrize(
    ("recorded_ms", "different", "same", "kept"),
    [(21.0, 950, 50, True), (21.1, 950, 50, False), (20.5, 949, 51, False), (20.5, 950, 49, False)],
    ids=["at its bounds", "too late", "too few pictures", "one picture is not counted"],
)
def test_recording_keeps_the_beat_and_counts_each_picture(
    recorded_ms: float, different: int, same: int, kept: bool
) -> None:
    stored = {"frames": 1000, "different": different, "same": same}
    assert beat_row("arms", [20.0] * 100, [recorded_ms] * 100, 1000, stored, 1.0).ok is kept


def test_a_writer_is_compared_by_the_medians_of_its_turns() -> None:
    rows = writer_rows({"ours": [6.0, 5.0, 99.0], "default": [10.0, 10.0, 1.0], "streaming": [5.0, 5.0, 5.0]}, 20.0)
    assert [(row.ratio, row.ok) for row in rows] == [(pytest.approx(0.6), True), (pytest.approx(1.2), False)]


def test_stops_count_where_something_was_recorded_meanwhile() -> None:
    assert stops_row([3.0] * 100, [2.0] * 100, {"frames": 50}).ok
    assert not stops_row([3.0] * 98 + [20.5] * 2, [2.0] * 100, {"frames": 50}).ok
    assert not stops_row([3.0] * 100, [2.0] * 100, {"frames": 0}).ok


def test_arm_of_the_benchmark_is_led_and_recorded(tmp_path: Path) -> None:
    robot = HardwareRobot(device(), "arm")
    robot.connect()
    try:
        arm = RecordedArm(robot, tmp_path / "set")
        arm.record_for(0.3, None)
    finally:
        robot.cleanup()
    assert len(arm.periods()) > 5
    assert read_info(arm.folder).episodes == 1


def test_cut_of_an_attempt_is_what_its_episode_lacks_of_the_actions() -> None:
    actions = [100 + beat / 50 for beat in range(101)]
    assert missing_s(actions, began=100.0, ended=102.0, frames=61) == pytest.approx(0.0)
    assert missing_s(actions, began=100.0, ended=102.0, frames=31) == pytest.approx(1.0)
    assert missing_s(actions, began=100.0, ended=101.0, frames=31) == pytest.approx(0.0)
    assert missing_s(actions, began=100.0, ended=102.0, frames=0) == pytest.approx(2.0, abs=0.05)
    assert missing_s(actions, began=103.0, ended=104.0, frames=0) == 0.0


def test_each_picture_carries_its_number() -> None:
    camera = ReplayedCamera()
    assert [stamped(camera.read_latest()) for _ in range(3)] == [1, 2, 3]
    noisy = stamp(np.full((240, 320, 3), 128, dtype=np.uint8), 54_321).astype(int)
    noise = np.random.default_rng(1).integers(-40, 40, noisy.shape)
    assert stamped(np.clip(noisy + noise, 0, 255).astype(np.uint8)) == 54_321


def test_two_policies_are_compared_seed_by_seed() -> None:
    better = [True] * 90 + [False] * 10
    assert paired_interval(better, better) == (0.0, 0.0, 0.0)
    mean, low, high = paired_interval([False] * 5 + better[5:], better)
    assert (mean, low) == (pytest.approx(-0.05), pytest.approx(-0.0929, abs=1e-3))
    assert high < 0
    assert train_row(better, better, 100, 2500).ok
    assert not train_row([False] * 8 + better[8:], better, 100, 2500).ok
    assert not train_row([False] * 100, [False] * 100, 2, 20).ok, "two that learned nothing are no proof"
