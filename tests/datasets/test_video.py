"""Live videos: whole up to their last group wherever they are cut, and copied without being encoded anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from strands_robots.datasets import DatasetError
from strands_robots.datasets.video import VideoWriter, copy_pictures, encoded_pictures, pictures_of

FPS = 30


@pytest.fixture
def live(tmp_path: Path) -> Path:
    """Nine pictures, the fifth a repeated one."""
    path = tmp_path / "live.mp4"
    with VideoWriter(path, FPS, 64, 48, live=True) as video:
        for number in (0, 1, 2, 3, 5, 6, 7, 8):
            video.write(np.full((48, 64, 3), 20 * number, dtype=np.uint8))
            if number == 3:
                video.repeat()
        video.finish()
    return path


def shades(path: Path) -> list[int]:
    return [round(float(picture.mean()) / 20) for picture in pictures_of(path)]


def test_each_second_picture_may_begin_a_copy(live: Path, tmp_path: Path) -> None:
    pictures = encoded_pictures(live)
    assert pictures is not None
    assert (pictures.width, pictures.height) == (64, 48)
    assert pictures.keys == [True, False] * 4 + [True]
    copy_pictures(live, tmp_path / "copy.mp4", 2, 5, FPS)
    assert shades(tmp_path / "copy.mp4") == [2, 3, 3, 5, 6]
    with pytest.raises(DatasetError, match="has 3 pictures from 6 on, not 4"):
        copy_pictures(live, tmp_path / "copy.mp4", 6, 4, FPS)


def test_video_that_is_cut_anywhere_has_the_groups_before(live: Path, tmp_path: Path) -> None:
    content, cut, copy = live.read_bytes(), tmp_path / "cut.mp4", tmp_path / "copy.mp4"
    found = []
    # Some of these places are within the heads of boxes.
    for size in range(0, len(content), 5):
        cut.write_bytes(content[:size])
        pictures = encoded_pictures(cut)
        found.append(0 if pictures is None else len(pictures.keys))
        if pictures is not None and found[-1] != found[-2]:
            copy_pictures(cut, copy, 0, found[-1], FPS)
            assert shades(copy) == [0, 1, 2, 3, 3, 5, 6, 7, 8][: found[-1]]
    assert sorted(found) == found
    assert set(found) >= {0, 2, 4, 6, 8}
