"""Videos of an episode: one picture a frame, encoded as it comes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from strands_robots.datasets.layout import DatasetError, sync
from strands_robots.datasets.statistics import PictureStatistics, Statistics
from strands_robots.utils import ValidationError, choice, optional_module, shown, whole

CODECS = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "23"}),
    "av1": ("libsvtav1", {"preset": "12", "crf": "30"}),
}
"""Encoder and its options, by codec."""

FIRST, EACH = 100, 10
"""Pictures that all count in the statistics; of the later ones, each so many."""


@dataclass(frozen=True, slots=True)
class Video:
    """A finished video of an episode, not yet in its dataset.

    ``about`` is what LeRobot states of a video in ``info.json``.
    """

    path: Path
    frames: int
    statistics: Statistics
    about: dict[str, Any]


class VideoWriter:
    """Encoder of one video; one picture a frame of the dataset.

    Args:
        path: written; it must not be a video of the dataset yet.
        fps: pictures a second.
        width: in pixels; even.
        height: in pixels; even.
        codec: of :data:`CODECS`.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
        ValidationError: a value outside its domain.
    """

    def __init__(self, path: Path, fps: int, width: int, height: int, codec: str = "h264") -> None:
        av = _pyav()
        for name, side in (("width", width), ("height", height)):
            if whole(name, side, low=2, high=16_384) % 2:
                raise ValidationError(f"{name} must be even, not {side}: a video halves its colours.")
        encoder, options = CODECS[choice("codec", codec, tuple(CODECS))]
        self.path, self._shape, self._codec, self._fps = path, (height, width, 3), codec, fps
        path.parent.mkdir(parents=True, exist_ok=True)
        self._statistics, self._count, self._av = PictureStatistics(), 0, av
        self._file = av.open(str(path), "w", format="mp4")
        # A picture that is asked for by its time is decoded from its nearest key picture: each second one is.
        self._stream = cast("Any", self._file.add_stream(encoder, rate=fps, options={**options, "g": "2", "bf": "0"}))
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.discard()

    def write(self, picture: NDArray[np.uint8]) -> None:
        """Encode the next picture, RGB in ``(height, width, 3)``.

        Raises:
            ValidationError: it has another shape or type.
            DatasetError: it cannot be encoded or written.
        """
        if picture.shape != self._shape or picture.dtype != np.uint8:
            raise ValidationError(f"picture must be uint8 of {self._shape}, not {picture.dtype} of {picture.shape}.")
        if self._count < FIRST or self._count % EACH == 0:
            self._statistics.add(picture)
        frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = self._count
        self._mux(frame)
        self._count += 1

    def finish(self) -> Video:
        """Write what is still encoded, and return the video once it is on the disk.

        Raises:
            DatasetError: it has no picture, or cannot be written.
        """
        if not self._count:
            raise DatasetError(f"{self.path.name} has no picture")
        self._mux(None)
        try:
            self._file.close()
            sync(self.path)
        except (OSError, self._av.FFmpegError) as exc:
            raise DatasetError(f"{self.path} cannot be written: {exc}") from exc
        height, width, channels = self._shape
        about = {
            "video.height": height,
            "video.width": width,
            "video.codec": self._codec,
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": self._fps,
            "video.channels": channels,
            "has_audio": False,
        }
        return Video(self.path, self._count, self._statistics.result(), about)

    def discard(self) -> None:
        """Close it; what is not finished is no video."""
        try:
            self._file.close()
        except (OSError, self._av.FFmpegError, ValueError):
            return

    def _mux(self, frame: Any) -> None:
        try:
            for packet in self._stream.encode(frame):
                self._file.mux(packet)
        except (OSError, self._av.FFmpegError) as exc:
            raise DatasetError(f"{self.path} cannot be written: {exc}") from exc


def pictures_of(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures of a video, RGB in ``(height, width, 3)``.

    Raises:
        DatasetError: it is no video, or it is cut off.
        MissingExtraError: the [dataset] extra is not installed.
    """
    av = _pyav()
    try:
        with av.open(str(path)) as file:
            for frame in file.decode(video=0):
                yield np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8)
    except (OSError, av.FFmpegError, IndexError) as exc:
        raise DatasetError(f"{shown(str(path))} cannot be read: {exc}") from exc


def _pyav() -> Any:
    return optional_module("av", what="A video", extra="dataset")
