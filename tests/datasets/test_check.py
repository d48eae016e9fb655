"""What a check tells: gaps, pictures that freeze, and pictures that are there twice."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from strands_robots.datasets import Dataset, DatasetEpisode, DatasetInfo, Feature
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.recorded import SAME
from strands_robots.datasets.video import Video, VideoWriter

FPS, FRAMES = 30, 60
Shade = Callable[[int], int]
TOP, WRIST = "observation.images.top", "observation.images.wrist"


def rising(number: int) -> int:
    return number * 4


def falling(number: int) -> int:
    return 255 - number * 4


def still(number: int) -> int:
    return 90


def saved(folder: Path, *episodes: tuple[Mapping[str, Shade], float], **columns: np.ndarray) -> list[tuple[str, bool]]:
    """Save episodes of such pictures, whose joint moves by so much; return what the check tells of them."""
    cameras = list(episodes[0][0])
    features = {"observation.state": Feature("float32", (2,), ("pan", "lift"))}
    features |= {name: Feature("bool" if values.dtype == bool else "float32") for name, values in columns.items()}
    features |= {name: Feature("video", (48, 64, 3)) for name in cameras}
    with Dataset(folder, DatasetInfo(FPS, features, "arm")) as dataset:
        for shades, moves in episodes:
            videos: dict[str, Video] = {}
            for name, shade in shades.items():
                with VideoWriter(dataset.running / f"{name}.mp4", FPS, 64, 48) as video:
                    for number in range(FRAMES):
                        video.write(np.full((48, 64, 3), shade(number), dtype=np.uint8))
                    videos[name] = video.finish()
            rows = np.linspace(0, moves, FRAMES * 2, dtype=np.float32).reshape(FRAMES, 2)
            dataset.save(DatasetEpisode("reach", {"observation.state": rows, **columns}, videos))
    return [(f"{each.where}: {each.said}", each.wrong) for each in check_dataset(folder)[1]]


def test_two_cameras_of_different_pictures_are_fine(tmp_path: Path) -> None:
    assert saved(tmp_path, ({TOP: rising, WRIST: falling}, 1.0)) == []


def test_two_cameras_with_the_same_pictures_are_wrong(tmp_path: Path) -> None:
    found = saved(tmp_path, ({TOP: rising, WRIST: lambda number: rising(number) + 1}, 1.0))
    assert found == [(f"episode 0: {TOP} and {WRIST} have the same pictures", True)]


def test_two_cameras_that_see_nothing_are_wrong_where_the_robot_moves(tmp_path: Path) -> None:
    dark = {TOP: still, WRIST: still}
    said = f"episode 0: {TOP} and {WRIST} have the same pictures"
    assert (said, True) in saved(tmp_path / "moves", (dark, 1.0))
    assert (said, False) in saved(tmp_path / "stands", (dark, 0.0))


def test_two_episodes_with_the_same_pictures_are_wrong_where_their_states_differ(tmp_path: Path) -> None:
    found = saved(tmp_path, ({TOP: rising}, 1.0), ({TOP: falling}, 1.0), ({TOP: rising}, 2.0), ({TOP: falling}, 1.0))
    assert found == [
        (f"episode 2: {TOP} has the pictures of episode 0, with other states", True),
        (f"episode 3: {TOP} has the pictures of episode 1, with the same states", False),
    ]


def test_camera_that_sees_nothing_move_is_no_double(tmp_path: Path) -> None:
    found = saved(tmp_path, ({TOP: still}, 1.0), ({TOP: still}, 2.0))
    assert (f"episode 1: {TOP} has the pictures of episode 0, with other states", False) in found
    assert not any(wrong for _, wrong in found)


def test_frames_that_say_themselves_that_their_picture_froze_are_told(tmp_path: Path) -> None:
    same = (np.arange(FRAMES) >= 10) & (np.arange(FRAMES) < 55)
    found = saved(tmp_path, ({TOP: rising}, 1.0), **{f"{SAME}top": same})
    assert found == [(f"episode 0, {TOP}: its picture stays the same for 1.5 s", False)]


@pytest.mark.parametrize(("pause", "told"), [(12, True), (2, False)])
def test_reading_that_did_not_come_for_long_is_a_gap(tmp_path: Path, pause: int, told: bool) -> None:
    ages = np.zeros(FRAMES, dtype=np.float32)
    ages[30 : 30 + pause] = np.arange(1, pause + 1) * 1000 / FPS
    found = saved(tmp_path, ({TOP: rising}, 1.0), **{"observation.age_ms.state": ages})
    said = (
        f"episode 0: no state was read for {(pause + 1) / FPS:.2f} s before frame {30 + pause}, and usually for 0.033 s"
    )
    assert found == ([(said, False)] if told else [])
