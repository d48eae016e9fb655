"""Videos encoded while their attempt ran, with a row of each picture.

Beside the recording ``attempt-000000.mcap`` the folder ``attempt-000000.cameras`` has for each camera a video, its
rows, and once it is finished its statistics. The first two are whole to their last second whenever their writer ends.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.bounded_json import json_object
from strands_robots.datasets.layout import CAMERAS
from strands_robots.datasets.statistics import PictureStatistics, Statistics
from strands_robots.datasets.video import (
    EACH,
    FIRST,
    Video,
    about_video,
    copy_pictures,
    encoded_pictures,
    pictures_of,
)
from strands_robots.utils import ValidationError

VIDEO, ROWS, STATISTICS = ".mp4", ".rows", ".json"

ROW = np.dtype([("moment", "<f8"), ("at", "<f8"), ("same", "<u8")])
"""Row of a picture: its moment on the grid and when it had arrived, both in seconds since the epoch, and 1 where it is
that of the row before."""

_STATISTICS_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class EncodedVideo:
    """Video of a camera on the grid of its attempt.

    Args:
        path: of the video.
        width: in pixels.
        height: in pixels.
        rows: of each picture, as :data:`ROW`.
        keys: which pictures may be the first one of a copy.
        statistics: of the pictures; None where it was not finished.
    """

    path: Path
    width: int
    height: int
    rows: NDArray[Any]
    keys: NDArray[np.bool_]
    statistics: Statistics | None

    def cut(self, target: Path, moments: NDArray[np.float64], fps: int) -> tuple[Video, NDArray[Any]]:
        """Copy pictures into a video of its own; return it and their rows.

        Args:
            target: the copy.
            moments: of the pictures, all of which it has.
            fps: moments a second.

        Raises:
            DatasetError: the copy cannot be written.
        """
        first = self.index(moments[0], fps)
        target.parent.mkdir(parents=True, exist_ok=True)
        copy_pictures(self.path, target, first, len(moments), fps)
        statistics = self.statistics or _statistics(target)
        video = Video(target, len(moments), statistics, about_video(self.width, self.height, fps))
        return video, self.rows[first : first + len(moments)]

    def index(self, moment: float, fps: int) -> int:
        """Return which of its pictures is that of a moment of its grid."""
        return round((moment - float(self.rows["moment"][0])) * fps)


def cameras_folder(recording: Path) -> Path:
    """Return the folder of the videos of a recording."""
    return recording.with_suffix(CAMERAS)


def offered_cameras(recording: Path) -> set[str]:
    """Return the cameras of which a picture came, also where none was encoded."""
    return {path.name.removesuffix(ROWS) for path in cameras_folder(recording).glob(f"*{ROWS}")}


def encoded_videos(recording: Path, fps: int) -> dict[str, EncodedVideo]:
    """Return the videos of a recording by camera.

    Those of a killed encoder go to its last whole group. A camera without a whole picture is left out.

    Raises:
        ValidationError: they were encoded at another rate.
        MissingExtraError: the [dataset] extra is not installed.
    """
    found = {}
    for path in sorted(cameras_folder(recording).glob(f"*{VIDEO}")):
        video = _read(path)
        if video is not None:
            steps = np.diff(video.rows["moment"]) * fps
            if not np.allclose(steps, 1.0, atol=0.01):
                raise ValidationError(f"fps must not be {fps}: {path} was encoded at another rate.")
            found[path.name.removesuffix(VIDEO)] = video
    return found


def common_moments(
    videos: Mapping[str, EncodedVideo], first_at: float, last_at: float, fps: int
) -> NDArray[np.float64]:
    """Return the moments between two of which every camera has a picture.

    The first one is a key picture of every camera, so that their videos are cut without being encoded anew.

    Args:
        videos: of one attempt, at least one.
        first_at: earliest moment, in seconds since the epoch.
        last_at: latest moment.
        fps: moments a second.
    """
    each = list(videos.values())
    latest = max(each, key=lambda video: float(video.rows["moment"][0]))
    moments = np.asarray(latest.rows["moment"])
    last = min([last_at, *(float(video.rows["moment"][-1]) for video in each)])
    # Times are kept in nanoseconds, and a step belongs to the frame that it comes with.
    soon = 1e-3 / fps
    moments = moments[(moments >= first_at - soon) & (moments <= last + soon)]
    for number, moment in enumerate(moments):
        if all(video.keys[video.index(moment, fps)] for video in each):
            return moments[number:]
    return moments[:0]


def write_statistics(video: Path, statistics: Statistics) -> None:
    """Write the statistics of a finished video beside it, whole or not at all."""
    path = video.with_suffix(STATISTICS)
    written = path.with_suffix(".part")
    stated = {name: value.tolist() for name, value in statistics.items()}
    written.write_text(json.dumps(stated, allow_nan=False), encoding="utf-8")
    written.replace(path)


def _read(path: Path) -> EncodedVideo | None:
    pictures = encoded_pictures(path)
    if pictures is None:
        return None
    rows = path.with_suffix(ROWS).read_bytes()
    found, statistics = np.frombuffer(rows, ROW, len(rows) // ROW.itemsize), None
    # After a power cut it may be there, and empty.
    with suppress(OSError, ValueError):
        stated = json_object(path.with_suffix(STATISTICS).read_bytes(), _STATISTICS_BYTES)
        statistics = {name: np.asarray(value) for name, value in stated.items()}
    # A row is written before its picture.
    count = min(len(found), len(pictures.keys))
    keys = np.array(pictures.keys[:count], dtype=bool)
    return EncodedVideo(path, pictures.width, pictures.height, found[:count], keys, statistics) if count else None


def _statistics(path: Path) -> Statistics:
    found = PictureStatistics()
    for index, picture in enumerate(pictures_of(path)):
        if index < FIRST or index % EACH == 0:
            found.add(picture)
    return found.result()
