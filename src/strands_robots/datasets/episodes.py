"""Episodes of one dataset: saved whole, indexed last, mended at the next opening.

An episode is written as: its frames, its videos, its row, the tasks, the statistics, and at the end the index in
``meta/info.json``. Each file is on the disk before the next one is named. A process that is killed in between leaves
files that the index does not count, which the next opening removes.
"""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from strands_robots.bounded_json import json_object
from strands_robots.datasets import statistics, tables
from strands_robots.datasets.layout import (
    CAMERAS,
    DATA_PATH,
    EPISODES_PATH,
    INFO,
    INFO_BYTES,
    STATS,
    TASKS,
    DatasetError,
    DatasetInfo,
    data_file,
    episodes_file,
    place_of,
    read_info,
    sync,
    video_file,
    write_json,
)
from strands_robots.datasets.statistics import Statistics
from strands_robots.datasets.video import Video
from strands_robots.utils import ValidationError, shown, text

LOCK, RUNNING = ".recorder.lock", ".running"
"""File that the process that records holds, and folder of what is not saved yet. LeRobot reads neither."""

RECORDING = ".mcap"
"""Suffix of a recording in that folder, which only :mod:`~strands_robots.datasets.session` removes."""

TASK_MAX = 1000
"""Longest task, in characters."""

POLICY = "policy"
"""Column of an episode's row, of our own: the policy that acted."""

FRAMES_MAX = 1_000_000
"""Most frames of one episode."""


@dataclass(frozen=True, slots=True)
class DatasetEpisode:
    """Frames of one attempt on the grid of its dataset.

    Args:
        task: what was to be done, in words.
        columns: by feature, ``(n,)`` numbers or ``(n, width)`` vectors, for each feature that is no video.
        videos: by feature, each of n pictures.
        policy: name of the policy that acted; several are divided by commas, and an empty one is none.
    """

    task: str
    columns: Mapping[str, NDArray[Any]]
    videos: Mapping[str, Video] = field(default_factory=dict)
    policy: str = ""


class DatasetHold:
    """Folder of a dataset that this process alone writes into, until it is closed.

    Args:
        folder: has a dataset, or is made.

    Raises:
        DatasetError: another process holds it, or it is a folder of others' files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not (folder / INFO).is_file():
            _require_empty(folder)
        self._new = not folder.exists()
        with _told(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(folder)

    @property
    def closed(self) -> bool:
        """True once it was let go of."""
        return self._lock < 0

    def close(self) -> None:
        """Let go of it, and remove a folder that is as new as it was. Twice is once."""
        if self._lock >= 0:
            if self._new:
                self._remove_empty()
            os.close(self._lock)
            self._lock = -1

    def _remove_empty(self) -> None:
        with suppress(OSError):
            if {path.name for path in self.folder.iterdir()} <= {LOCK, RUNNING}:
                if (self.folder / RUNNING).is_dir():
                    # Refused where something is in it.
                    (self.folder / RUNNING).rmdir()
                (self.folder / LOCK).unlink()
                self.folder.rmdir()


class Dataset:
    """Dataset in a folder, held by this process until it is closed.

    Args:
        folder: has a dataset, or is made.
        info: what is recorded into it; None to open what is there.
        hold: of the folder, which the dataset closes with itself; its own by default.

    Raises:
        DatasetError: another process records into it, it cannot be read or written, or it is a folder of others' files.
        ValidationError: what is there has other features, names or another rate.
        MissingExtraError: the [dataset] extra is not installed.
    """

    def __init__(self, folder: Path, info: DatasetInfo | None = None, hold: DatasetHold | None = None) -> None:
        tables.pyarrow()
        self.folder = folder
        self.mended: list[str] = []
        """What the opening removed or wrote anew."""

        self.info: DatasetInfo
        self.tasks: list[str] = []
        self.statistics: dict[str, Statistics] = {}

        known = (folder / INFO).is_file()
        if not known and info is None:
            raise DatasetError(f"{folder} has no dataset: there is no {INFO}")
        self._hold = DatasetHold(folder) if hold is None else hold
        try:
            with _told(folder):
                self._open(info, known)
        except BaseException:
            if hold is None:
                self._hold.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def running(self) -> Path:
        """Folder for the videos of the episode that is recorded; emptied at each opening."""
        return self.folder / RUNNING

    def close(self) -> None:
        """Let go of it. Twice is once."""
        if not self._hold.closed:
            self._remove(self._unsaved())
            self._hold.close()

    def save(self, episode: DatasetEpisode) -> int:
        """Save an episode: once this returns, it outlives a kill and a power cut.

        Returns:
            Its index.

        Raises:
            ValidationError: a column is missing, too many, of another length or not finite.
            DatasetError: it cannot be written; the dataset is as it was.
        """
        if self._hold.closed:
            raise DatasetError(f"{self.folder} is closed")
        number, count = self.info.episodes, self._checked(episode)
        tasks = self.tasks if episode.task in self.tasks else [*self.tasks, episode.task]
        columns = self._counted(episode, count, tasks.index(episode.task))
        found = {name: statistics.of_column(values) for name, values in columns.items()}
        found |= {name: each.statistics for name, each in episode.videos.items()}
        features = {
            name: replace(each, about=episode.videos[name].about) if each.video and not each.about else each
            for name, each in self.info.features.items()
        }
        info = replace(
            self.info,
            features=features,
            episodes=number + 1,
            frames=self.info.frames + count,
            tasks=len(tasks),
        )
        with _told(self.folder):
            try:
                tables.write_frames(self.folder / data_file(number), self.info.columns, columns)
                for name, video in episode.videos.items():
                    self._take(video.path, self.folder / video_file(name, number))
                row = self._row(number, count, episode)
                tables.write_episode(self.folder / episodes_file(number), row, found)
                if tasks != self.tasks:
                    tables.write_tasks(self.folder / TASKS, tasks)
                whole = self._with(found)
                write_json(self.folder / STATS, statistics.as_json(whole))
                write_json(self.folder / INFO, info.stated())
            except BaseException:
                # The index decides: what it does not count is removed here, or at the next opening.
                with suppress(OSError):
                    self._remove(self._uncounted())
                raise
        self.info, self.tasks, self.statistics = info, tasks, whole
        return number

    def _open(self, info: DatasetInfo | None, known: bool) -> None:
        if known:
            self.info = read_info(self.folder)
            if info is not None and (differences := self.info.differences(info)):
                raise ValidationError(f"{self.folder} has another kind of episodes: {'; '.join(differences)}.")
        else:
            assert info is not None
            self.info = replace(info, episodes=0, frames=0, tasks=0)
            write_json(self.folder / INFO, self.info.stated())
        # Before anything is removed: a dataset that was written otherwise has its episodes in other files.
        for number in self._numbers():
            for path in self._files(number):
                if not (self.folder / path).is_file():
                    raise DatasetError(f"{self.folder} states {self.info.episodes} episodes and has no {path}")
        self._remove(self._uncounted(), told=True)
        if (self.folder / TASKS).is_file():
            # A task of an episode that was not indexed may stand at the end.
            self.tasks = tables.read_tasks(self.folder / TASKS)[: self.info.tasks]
        if len(self.tasks) < self.info.tasks:
            raise DatasetError(f"{self.folder} states {self.info.tasks} tasks, and {TASKS} has {len(self.tasks)}")
        self.statistics = self._read_statistics()

    def _read_statistics(self) -> dict[str, Statistics]:
        """Return the statistics of all episodes; ``stats.json`` may be of others."""
        if not self.info.episodes:
            return {}
        with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
            stated = json_object((self.folder / STATS).read_bytes(), INFO_BYTES)
            found = {key: {name: np.asarray(value) for name, value in of.items()} for key, of in stated.items()}
            if int(found["index"]["count"][0]) == self.info.frames:
                return found
        rows = [tables.statistics_of(tables.read_row(self.folder / episodes_file(n))) for n in self._numbers()]
        whole = {key: statistics.aggregated(row[key] for row in rows) for key in rows[0]}
        write_json(self.folder / STATS, statistics.as_json(whole))
        self.mended.append(f"{STATS} was of other episodes, and is written anew")
        return whole

    def _checked(self, episode: DatasetEpisode) -> int:
        """Return how many frames an episode has.

        Raises:
            ValidationError: it does not fit the dataset.
        """
        text("task", episode.task, longest=TASK_MAX)
        wanted = {name: each for name, each in self.info.features.items() if not each.video}
        for kind, has, needs in (
            ("columns", episode.columns, wanted),
            ("videos", episode.videos, self.info.videos),
        ):
            if has.keys() != needs.keys():
                odd = ", ".join(sorted(has.keys() ^ needs.keys()))
                raise ValidationError(f"{kind} must be {', '.join(needs) or 'none'}; {odd} is missing or too many.")
        lengths = {name: len(values) for name, values in episode.columns.items()}
        lengths |= {name: each.frames for name, each in episode.videos.items()}
        count = next(iter(lengths.values()))
        if not 1 <= count <= FRAMES_MAX:
            raise ValidationError(f"an episode must have 1 to {FRAMES_MAX:,} frames, not {count:,}.")
        for name, length in lengths.items():
            if length != count:
                raise ValidationError(f"{name} must have {count} frames as the others, not {length}.")
        for name, feature in wanted.items():
            values = np.asarray(episode.columns[name])
            shape = (count,) if feature.shape == (1,) else (count, *feature.shape)
            if values.shape != shape:
                raise ValidationError(f"{name} must have the shape {shape}, not {values.shape}.")
            if values.dtype.kind not in "bif" or (values.dtype.kind == "b") != (feature.dtype == "bool"):
                raise ValidationError(f"{name} must be {feature.dtype}, not {values.dtype}.")
            if not np.isfinite(values).all():
                bad = int(np.argwhere(~np.isfinite(values.reshape(count, -1)).all(axis=1))[0][0])
                raise ValidationError(f"{name} must be finite; frame {bad} is {shown(values[bad].tolist())}.")
        return count

    def _counted(self, episode: DatasetEpisode, count: int, task: int) -> dict[str, NDArray[Any]]:
        frames = np.arange(count, dtype=np.int64)
        counted: dict[str, NDArray[Any]] = {
            "timestamp": (frames / self.info.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(count, self.info.episodes, dtype=np.int64),
            "index": frames + self.info.frames,
            "task_index": np.full(count, task, dtype=np.int64),
        }
        given = {name: np.asarray(episode.columns[name]) for name in self.info.columns if name in episode.columns}
        return {**given, **counted}

    def _row(self, number: int, count: int, episode: DatasetEpisode) -> dict[str, Any]:
        row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": count}
        row |= {"dataset_from_index": self.info.frames, "dataset_to_index": self.info.frames + count}
        row |= place_of(number, "data")
        for name in episode.videos:
            row |= place_of(number, f"videos/{name}")
            row |= {f"videos/{name}/from_timestamp": 0.0, f"videos/{name}/to_timestamp": count / self.info.fps}
        # LeRobot 0.4.4 and 0.6.1 load no dataset of which a later row has a column more than the first.
        if not number or POLICY in tables.read_row(self.folder / episodes_file(0)):
            row[POLICY] = episode.policy
        return row | place_of(number, "meta/episodes")

    def _with(self, found: Mapping[str, Statistics]) -> dict[str, Statistics]:
        """Return the statistics of all episodes with one more."""
        before = self.statistics
        return {
            key: statistics.aggregated([before[key], each] if key in before else [each]) for key, each in found.items()
        }

    def _take(self, written: Path, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        sync(written)
        written.replace(path)
        sync(path.parent)

    def _numbers(self) -> range:
        return range(self.info.episodes)

    def _files(self, number: int) -> list[Path]:
        return [
            data_file(number),
            episodes_file(number),
            *(video_file(name, number) for name in self.info.videos),
        ]

    def _uncounted(self) -> Iterator[Path]:
        """Yield the files that the index does not count: of a killed recorder."""
        known = {self.folder / path for number in self._numbers() for path in self._files(number)}
        for top in (DATA_PATH.partition("/")[0], EPISODES_PATH.rpartition("/chunk")[0], "videos"):
            yield from (path for path in tables.files_in(self.folder / top) if path not in known)
        yield from self._unsaved()
        yield from (self.folder / "meta").glob(".*.part")

    def _unsaved(self) -> Iterator[Path]:
        """Yield what is half made of an episode, without its recording and cameras."""
        for path in tables.files_in(self.running):
            if path.suffix != RECORDING and path.parent.suffix != CAMERAS:
                yield path

    def _remove(self, paths: Iterator[Path], *, told: bool = False) -> None:
        for path in paths:
            path.unlink(missing_ok=True)
            if told:
                self.mended.append(f"{path.relative_to(self.folder)} was not saved, and is removed")


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """Raise what the disk refuses as a :class:`DatasetError` that says so."""
    try:
        yield
    except OSError as problem:
        full = " The disk is full." if problem.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        raise DatasetError(f"{folder} cannot be written: {problem.strerror or problem}.{full}") from problem


def _require_empty(folder: Path) -> None:
    if folder.is_file():
        raise DatasetError(f"{folder} is a file")
    others = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    if strange := [name for name in others if name not in (LOCK, RUNNING, "meta")]:
        raise DatasetError(f"{folder} has no dataset and is not empty: it has {', '.join(sorted(strange)[:3])}")


def _locked(folder: Path) -> int:
    descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise DatasetError(f"{folder} is recorded into by another process") from None
    return descriptor
