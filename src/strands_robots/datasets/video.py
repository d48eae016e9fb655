"""Videos of an episode: one picture a frame, encoded as it comes."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, Self, cast

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

GROUP = 2
"""Pictures from one key picture to the next, from which one that is asked for by its time is decoded."""

_LIVE = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
"""Options of a file that is readable up to its last group whenever its writer ends."""

_BOX = struct.Struct(">I4s")


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
        live: readable up to its last groups whenever the process ends, with a key picture at each even one; encoded
            on one thread.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
        ValidationError: a value outside its domain.
    """

    def __init__(
        self, path: Path, fps: int, width: int, height: int, codec: str = "h264", *, live: bool = False
    ) -> None:
        av = _pyav()
        for name, side in (("width", width), ("height", height)):
            if whole(name, side, low=2, high=16_384) % 2:
                raise ValidationError(f"{name} must be even, not {side}: a video halves its colours.")
        encoder, options = CODECS[choice("codec", codec, tuple(CODECS))]
        self.path, self._shape, self._codec, self._fps = path, (height, width, 3), codec, fps
        path.parent.mkdir(parents=True, exist_ok=True)
        self._statistics, self._count, self._av = PictureStatistics(), 0, av
        self._frame: Any = None
        self._file = av.open(str(path), "w", format="mp4", options=_LIVE if live else {})
        options = {**options, "g": str(GROUP), "bf": "0"}
        if live and encoder == "libx264":
            options["sc_threshold"] = "0"  # a change of scene would begin a group at an odd picture
        self._stream = cast("Any", self._file.add_stream(encoder, rate=fps, options=options))
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        if live:
            self._stream.codec_context.thread_count = 1

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
        self._frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
        self._encode()

    def repeat(self) -> None:
        """Encode the picture before once more, which costs less than a new one.

        Raises:
            DatasetError: there is none, or it cannot be written.
        """
        if self._frame is None:
            raise DatasetError(f"{self.path.name} has no picture")
        self._encode()

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
        height, width, _ = self._shape
        about = about_video(width, height, self._fps, self._codec)
        return Video(self.path, self._count, self._statistics.result(), about)

    def discard(self) -> None:
        """Close it; what is not finished is no video."""
        try:
            self._file.close()
        except (OSError, self._av.FFmpegError, ValueError):
            return

    def _encode(self) -> None:
        self._frame.pts = self._count
        self._mux(self._frame)
        self._count += 1

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


def about_video(width: int, height: int, fps: int, codec: str = "h264") -> dict[str, Any]:
    """Return what LeRobot states of a video in ``info.json``."""
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": codec,
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
    }


@dataclass(frozen=True, slots=True)
class EncodedPictures:
    """Encoded pictures of a video; a copy may begin with one of ``keys``."""

    width: int
    height: int
    keys: list[bool]


def encoded_pictures(path: Path) -> EncodedPictures | None:
    """Return the encoded pictures of a live video; None where it has none.

    A cut file has the groups that are whole.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
    """
    av = _pyav()
    keys: list[bool] = []
    with suppress(OSError, av.FFmpegError, IndexError), _whole_part(path) as part, av.open(part) as file:
        context: Any = file.streams.video[0].codec_context
        if context is None:
            return None  # it was cut in its head
        width, height = context.width, context.height
        keys.extend(bool(packet.is_keyframe) for packet in file.demux(video=0) if packet.size)
    return EncodedPictures(width, height, keys) if keys else None


def copy_pictures(path: Path, target: Path, first: int, count: int, fps: int) -> None:
    """Copy ``count`` pictures of a live video without encoding them anew.

    ``first`` is a key picture.

    Raises:
        DatasetError: it has fewer, or the copy cannot be written.
        MissingExtraError: the [dataset] extra is not installed.
    """
    av, copied = _pyav(), 0
    try:
        with _whole_part(path) as part, av.open(part) as file, av.open(str(target), "w", format="mp4") as out:
            stream = out.add_stream_from_template(file.streams.video[0])
            for number, packet in enumerate(file.demux(video=0)):
                if copied == count or not packet.size:
                    break
                if number >= first:
                    packet.stream, packet.time_base = stream, Fraction(1, fps)
                    packet.pts = packet.dts = copied
                    packet.duration = 1
                    out.mux(packet)
                    copied += 1
    except (OSError, av.FFmpegError, IndexError) as exc:
        raise DatasetError(f"{target} cannot be written: {exc}") from exc
    if copied != count:
        raise DatasetError(f"{path} has {copied} pictures from {first} on, not {count}")


class _Part:
    """The beginning of a file, as PyAV reads it."""

    def __init__(self, file: BinaryIO, length: int) -> None:
        self._file, self._length = file, length
        self.tell = file.tell
        file.seek(0)

    def read(self, count: int) -> bytes:
        return self._file.read(max(0, min(count, self._length - self._file.tell())))

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            return self._file.seek(self._length + offset)
        return self._file.seek(offset, whence)


@contextmanager
def _whole_part(path: Path) -> Iterator[_Part]:
    """Yield a live video without what is cut at its end.

    FFmpeg may refuse all of a video for it. ISO/IEC 14496-12, 4.2: a box begins with its size and kind; a group is a
    box ``moof`` and one ``mdat``.
    """
    with path.open("rb") as file:
        total, place, whole = os.fstat(file.fileno()).st_size, 0, 0
        while len(head := file.read(_BOX.size)) == _BOX.size:
            size, kind = _BOX.unpack(head)
            if size < _BOX.size or place + size > total:
                break
            place = file.seek(place + size)
            if kind != b"moof":
                whole = place
        yield _Part(file, whole)


def decoded(jpeg: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a JPEG, RGB in ``(height, width, 3)``.

    Raises:
        DatasetError: it is none, or larger than a camera's.
    """
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415 - an extra

    try:
        with Image.open(io.BytesIO(jpeg), formats=["JPEG"]) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as exc:
        raise DatasetError(f"a picture cannot be decoded: {exc}") from exc


def _pyav() -> Any:
    return optional_module("av", what="A video", extra="dataset")
