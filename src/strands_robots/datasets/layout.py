"""Files of a LeRobot dataset v3.0, and what its ``meta/info.json`` states.

Source: LeRobot 0.4.4 and 0.6.1, whose loaders read what is written here. One data file and one video an episode is
legal there, and is what makes a saved episode durable.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from strands_robots.bounded_json import json_object
from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import ValidationError, choice, number, shown, text, whole

VERSION = "v3.0"
CHUNK_FILES = 1000
"""Files of one folder."""

INFO, STATS, TASKS = Path("meta/info.json"), Path("meta/stats.json"), Path("meta/tasks.parquet")
INFO_BYTES = 2**24
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

CAMERAS = ".cameras"
"""Suffix of the folder with the videos of a running attempt, beside its recording."""

DTYPES = ("float32", "float64", "int64", "bool", "video")
FEATURES_MAX, WIDTH_MAX = 500, 10_000
"""Most features, and most numbers of one."""

FPS_MAX = 1000


class DatasetError(StrandsRobotsError):
    """A dataset that cannot be read or written; the text says where and why."""


@dataclass(frozen=True, slots=True)
class Feature:
    """One column of a dataset: a number, a vector of named numbers, or a video.

    Args:
        dtype: one of :data:`DTYPES`.
        shape: ``(1,)`` of a number, ``(n,)`` of a vector, ``(height, width, 3)`` of a video, in pixels.
        names: of a vector's numbers, from the robot.

    Raises:
        ValidationError: a value outside its domain.
    """

    dtype: str
    shape: tuple[int, ...] = (1,)
    names: tuple[str, ...] = ()
    about: Mapping[str, Any] = field(default_factory=dict)
    """Of a video, once there is one: its codec and size as LeRobot states them. Of codes: their names."""

    units: tuple[str, ...] = ()
    """Of a vector's numbers, from the robot; empty where it states none. LeRobot does not read them."""

    def __post_init__(self) -> None:
        choice("dtype", self.dtype, DTYPES)
        sides = 3 if self.video else 1
        if len(self.shape) != sides:
            raise ValidationError(f"shape of a {self.dtype} must have {sides} sides, not {shown(self.shape)}.")
        for side in self.shape:
            whole("shape", side, low=1, high=WIDTH_MAX)
        if self.names and len(self.names) != self.shape[-1]:
            raise ValidationError(f"names must be {self.shape[-1]}, as the shape states, not {len(self.names)}.")
        if self.units and len(self.units) != len(self.names):
            raise ValidationError(f"units must be {len(self.names)}, as the names are, not {len(self.units)}.")
        if len(set(self.names)) != len(self.names):
            raise ValidationError(f"names must differ: {', '.join(self.names)}.")

    @property
    def video(self) -> bool:
        """True for a video, whose pictures are in a file of its own."""
        return self.dtype == "video"

    def stated(self) -> dict[str, Any]:
        """Return it as ``info.json`` states it."""
        names: list[str] | None = list(self.names) or None
        if self.video:
            names = ["height", "width", "channels"]
        stated: dict[str, Any] = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        if self.units:
            stated["units"] = list(self.units)
        return {**stated, "info": dict(self.about)} if self.about else stated


INDEX = {
    "timestamp": Feature("float32"),
    "frame_index": Feature("int64"),
    "episode_index": Feature("int64"),
    "index": Feature("int64"),
    "task_index": Feature("int64"),
}
"""Columns that every dataset has, and that are counted here."""


@dataclass(frozen=True, slots=True)
class DatasetInfo:
    """Rate, features and totals that a dataset states of itself.

    Args:
        fps: frames a second.
        features: by name, without those of :data:`INDEX`.
        robot_type: kind of the robot, for whoever trains.

    Raises:
        ValidationError: a value outside its domain.
    """

    fps: int
    features: Mapping[str, Feature]
    robot_type: str = "unknown"
    episodes: int = 0
    frames: int = 0
    tasks: int = 0

    def __post_init__(self) -> None:
        whole("fps", self.fps, low=1, high=FPS_MAX)
        text("robot_type", self.robot_type, longest=100)
        whole("features", len(self.features), low=1, high=FEATURES_MAX)
        for name in self.features:
            checked_feature_name(name)

    @property
    def videos(self) -> dict[str, Feature]:
        """The features whose pictures are videos."""
        return {name: each for name, each in self.features.items() if each.video}

    @property
    def columns(self) -> dict[str, Feature]:
        """The features of the data files, in their order."""
        return {name: each for name, each in (*self.features.items(), *INDEX.items()) if not each.video}

    def stated(self) -> dict[str, Any]:
        """Return the content of ``info.json``."""
        features = {name: each.stated() for name, each in (*self.features.items(), *INDEX.items())}
        return {
            "codebase_version": VERSION,
            "robot_type": self.robot_type,
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": self.tasks,
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.fps,
            "splits": {"train": f"0:{self.episodes}"} if self.episodes else {},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if self.videos else None,
            "features": features,
        }

    def differences(self, other: DatasetInfo) -> list[str]:
        """Return what keeps episodes of ``other`` out of this dataset."""
        found = [] if self.fps == other.fps else [f"fps is {self.fps} here, not {other.fps}"]
        found += [
            f"{name} is {'not ' if name in self.features else ''}among what is recorded"
            for name in sorted(self.features.keys() ^ other.features.keys())
        ]
        for name in self.features.keys() & other.features.keys():
            mine, its = (replace(each.features[name], about={}) for each in (self, other))
            if not mine.units or not its.units:
                # One that states none may be of the same.
                mine, its = replace(mine, units=()), replace(its, units=())
            if mine != its:
                found.append(f"{name} is {_told(mine)} here, not {_told(its)}")
        return found


def checked_feature_name(name: object) -> str:
    """Return the name of a feature, which is a folder's name as well.

    Raises:
        ValidationError: it is none.
    """
    checked = text("feature", name, longest=200)
    if checked in INDEX:
        raise ValidationError(f"feature must not be {checked}: it is counted.")
    if "/" in checked or "\\" in checked or checked.startswith(".") or not checked.isprintable():
        raise ValidationError(f"feature must be a name without slashes, not {shown(name)}.")
    return checked


def read_info(folder: Path) -> DatasetInfo:
    """Return what the dataset in a folder states.

    Raises:
        DatasetError: it states nothing that can be read, or another version.
    """
    path = folder / INFO
    try:
        return _info(path)
    except (OSError, ValueError, KeyError, TypeError) as exc:
        said = f"it has no {exc}" if isinstance(exc, KeyError) else str(exc)
        raise DatasetError(f"{path} cannot be read: {said}") from exc


def _info(path: Path) -> DatasetInfo:
    if (size := path.stat().st_size) > INFO_BYTES:
        raise ValueError(f"it has {size:,} bytes")
    stated = json_object(path.read_bytes(), INFO_BYTES)
    if stated.get("codebase_version") != VERSION:
        raise ValueError(f"codebase_version is {shown(stated.get('codebase_version'))}, not {VERSION}")
    layout = {"data_path": DATA_PATH, "video_path": VIDEO_PATH, "chunks_size": CHUNK_FILES}
    for name, mine in layout.items():
        if stated.get(name) not in (mine, None):
            raise ValueError(f"{name} is {shown(stated[name])}, and of what is recorded here {mine}")
    features = {str(name): _feature(each) for name, each in dict(stated["features"]).items() if name not in INDEX}
    totals = (whole(f"total_{each}", stated[f"total_{each}"], low=0) for each in ("episodes", "frames", "tasks"))
    return DatasetInfo(int(number("fps", stated["fps"])), features, str(stated.get("robot_type")), *totals)


def data_file(episode: int) -> Path:
    """Return the data file of an episode."""
    return Path(DATA_PATH.format(**_place(episode)))


def video_file(key: str, episode: int) -> Path:
    """Return the file of an episode's video."""
    return Path(VIDEO_PATH.format(video_key=key, **_place(episode)))


def episodes_file(episode: int) -> Path:
    """Return the file with the row of an episode."""
    return Path(EPISODES_PATH.format(**_place(episode)))


def place_of(episode: int, prefix: str) -> dict[str, int]:
    """Return where an episode's file is, as the row of the episode states it."""
    return {f"{prefix}/{name}": value for name, value in _place(episode).items()}


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a file that takes the place of ``path`` once it is on the disk.

    Where the block raises, it is removed, and ``path`` is as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    written = path.with_name(f".{path.name}.part")
    try:
        yield written
        sync(written)
        written.replace(path)
    finally:
        written.unlink(missing_ok=True)
    sync(path.parent)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file of JSON whole or not at all."""
    with replaced(path) as written:
        written.write_text(json.dumps(content, indent=4, allow_nan=False), encoding="utf-8")


def sync(path: Path) -> None:
    """Have what is written of a file or of a folder's names put on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _place(episode: int) -> dict[str, int]:
    return {"chunk_index": episode // CHUNK_FILES, "file_index": episode % CHUNK_FILES}


def _feature(stated: Any) -> Feature:
    names = stated.get("names")
    if isinstance(names, Mapping) and len(names) == 1:
        names = next(iter(names.values()))
    video = stated["dtype"] == "video"
    kept = tuple(map(str, names)) if isinstance(names, list) and not video else ()
    units = stated.get("units")
    told = tuple(map(str, units)) if isinstance(units, list) and len(units) == len(kept) else ()
    return Feature(str(stated["dtype"]), tuple(stated["shape"]), kept, dict(stated.get("info") or {}), told)


def _told(feature: Feature) -> str:
    each = [" in ".join(filter(None, pair)) for pair in zip_longest(feature.names, feature.units, fillvalue="")]
    names = f" ({', '.join(each)})" if each else ""
    return f"{feature.dtype} {'x'.join(map(str, feature.shape))}{names}"
