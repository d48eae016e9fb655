"""Check of a dataset against itself: counts, grid, videos, ages, gaps, jumps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.datasets import tables
from strands_robots.datasets.doubles import EVERY, SAMPLES_MAX, Doubles, Look, cells_of
from strands_robots.datasets.layout import (
    INDEX,
    STATS,
    TASKS,
    DatasetError,
    DatasetInfo,
    data_file,
    episodes_file,
    read_info,
    video_file,
)
from strands_robots.datasets.recorded import IMAGES, SAME, STATE
from strands_robots.datasets.video import pictures_of
from strands_robots.utils import number

OLDEST_MS = 500.0
"""Age of a reading, in milliseconds, from which a frame does not tell what was."""

FROZEN_S = 1.0
"""Seconds for which pictures may stay the same."""

GAP_TIMES, GAP_S = 10.0, 0.1
"""A gap between two readings is so many times their median distance, and at least so many seconds."""

JUMP_SHARE = 0.5
"""Part of a joint's whole range that it may go in one frame."""

STILL = 0.01
"""Way of a joint, in its unit, that is not looked at."""

_GRID_S = 1e-4
"""Tolerance of LeRobot's loaders in time."""


@dataclass(frozen=True, slots=True)
class DatasetFinding:
    """One thing that is wrong, or that may be.

    ``wrong`` is True for what a loader refuses or reads falsely, and False for what a person should look at.
    """

    where: str
    said: str
    wrong: bool = True


def check_dataset(
    folder: Path, *, oldest_ms: float = OLDEST_MS, doubles: bool = True
) -> tuple[DatasetInfo, list[DatasetFinding]]:
    """Check each episode of a dataset; read, never written.

    Args:
        folder: of the dataset.
        oldest_ms: age of a reading from which it is told.
        doubles: also look for pictures that are there twice; not where they are replayed.

    Raises:
        DatasetError: it has no index that can be read.
        MissingExtraError: the [dataset] extra is not installed.
    """
    number("oldest_ms", oldest_ms, above=0, high=60_000)
    info = read_info(folder)
    found = list(_whole(folder, info))
    start, seen = 0, Doubles()
    for episode in range(info.episodes):
        where = f"episode {episode}"
        try:
            frames = tables.read_frames(folder / data_file(episode))
            row = tables.read_row(folder / episodes_file(episode))
            count = _count(frames)
            found += [DatasetFinding(where, said) for said in _index(info, episode, start, frames, row)]
            found += [DatasetFinding(where, said, wrong=False) for said in _ages(frames, oldest_ms)]
            found += [DatasetFinding(where, said, wrong=False) for said in _jumps(info, frames)]
            found += [DatasetFinding(where, said, wrong=False) for said in _gaps(info, frames)]
            looks = {}
            for name in info.videos:
                same = frames.get(SAME + name.removeprefix(IMAGES), np.zeros(0, dtype=bool))
                cells: list[NDArray[np.float32]] = []
                found += _video(folder / video_file(name, episode), info.fps, count, f"{where}, {name}", same, cells)
                looks[name] = Look(np.array(cells))
            state = np.asarray(frames.get(STATE, np.zeros(count)), dtype=np.float64).reshape(count, -1)
            if doubles:
                found += [DatasetFinding(where, said, wrong) for said, wrong in seen.add(episode, looks, state)]
            start += count
        except DatasetError as exc:
            found.append(DatasetFinding(where, str(exc)))
    if start != info.frames and not any(each.wrong for each in found):
        found.append(DatasetFinding("info.json", f"it states {info.frames} frames, and the episodes have {start}"))
    return info, found


def _whole(folder: Path, info: DatasetInfo) -> Iterator[DatasetFinding]:
    if not info.episodes:
        yield DatasetFinding("info.json", "it has no episodes", wrong=False)
        return
    try:
        tasks = tables.read_tasks(folder / TASKS)
    except DatasetError as exc:
        yield DatasetFinding("tasks", str(exc))
    else:
        if len(tasks) < info.tasks:
            yield DatasetFinding("tasks", f"info.json states {info.tasks}, and {TASKS} has {len(tasks)}")
    if not (folder / STATS).is_file():
        yield DatasetFinding("stats", f"there is no {STATS}")


def _count(frames: dict[str, NDArray[Any]]) -> int:
    lengths = {len(values) for values in frames.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise DatasetError("its columns have no frames, or not all the same number")
    return lengths.pop()


def _index(
    info: DatasetInfo, episode: int, start: int, frames: dict[str, NDArray[Any]], row: dict[str, Any]
) -> Iterator[str]:
    count = len(frames["frame_index"]) if "frame_index" in frames else 0
    if odd := sorted(frames.keys() ^ info.columns.keys()):
        yield f"its columns are not those of info.json: {', '.join(odd)}"
        return
    for name, feature in info.columns.items():
        shape = (count,) if feature.shape == (1,) else (count, *feature.shape)
        if frames[name].shape != shape:
            yield f"{name} has the shape {frames[name].shape}, not {shape}"
        elif frames[name].dtype.kind == "f" and not np.isfinite(frames[name]).all():
            yield f"{name} has values that are no finite numbers"
    grid = np.arange(count) / info.fps
    if count and np.abs(frames["timestamp"] - grid).max() > _GRID_S:
        yield f"its timestamps are not those of {info.fps} frames a second"
    expected = {
        "frame_index": np.arange(count),
        "index": start + np.arange(count),
        "episode_index": np.full(count, episode),
    }
    for name, values in expected.items():
        if not np.array_equal(frames[name], values):
            yield f"{name} does not count on from the episode before"
    stated = (row.get("length"), row.get("dataset_from_index"), row.get("dataset_to_index"))
    if stated != (count, start, start + count):
        yield f"its row states {stated}, and its frames are {(count, start, start + count)}"


def _ages(frames: dict[str, NDArray[Any]], oldest_ms: float) -> Iterator[str]:
    for name, values in frames.items():
        if ".age_ms." in name and len(values) and values.max() > oldest_ms:
            at = int(values.argmax())
            yield f"{name.rpartition('.')[2]} is {values[at]:.0f} ms old at frame {at}"


def _jumps(info: DatasetInfo, frames: dict[str, NDArray[Any]]) -> Iterator[str]:
    for key, feature in info.columns.items():
        if key in INDEX or not feature.names or len(frames.get(key, ())) < 3:
            continue
        # A vector of one number is a plain column.
        values = np.asarray(frames[key], dtype=np.float64).reshape(len(frames[key]), -1)
        reach, steps = np.ptp(values, axis=0), np.abs(np.diff(values, axis=0))
        for column in np.flatnonzero((steps.max(axis=0) > JUMP_SHARE * reach) & (reach > STILL)):
            at = int(steps[:, column].argmax()) + 1
            yield f"{feature.names[column]} of {key} jumps by {steps[at - 1, column]:.3g} at frame {at}"


def _gaps(info: DatasetInfo, frames: dict[str, NDArray[Any]]) -> Iterator[str]:
    """Tell of a reading that came much later after the one before than most do."""
    for name, ages in frames.items():
        if ".age_ms." not in name or len(ages) < 3:
            continue
        read_at = np.arange(len(ages)) / info.fps - np.asarray(ages, dtype=np.float64) / 1000
        moments = read_at[np.concatenate([[True], np.diff(read_at) > _GRID_S])]
        apart = np.diff(moments)
        usual = float(np.median(apart)) if len(apart) else 0.0
        long = apart > max(GAP_TIMES * usual, GAP_S)
        if long.any():
            at = int(np.searchsorted(read_at, moments[int(apart.argmax()) + 1] - _GRID_S))
            said = f"no {name.rpartition('.')[2]} was read for {apart.max():.2f} s before frame {at}"
            yield f"{said}, and usually for {usual:.3f} s" + (f"; {long.sum()} such gaps" if long.sum() > 1 else "")


def _longest(same: NDArray[Any]) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(same, dtype=np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _video(  # noqa: PLR0917 - one video, and what its frames say
    path: Path, fps: int, count: int, where: str, marked: NDArray[Any], cells: list[NDArray[np.float32]]
) -> Iterator[DatasetFinding]:
    """Count the pictures of a video, and how long they stay the same.

    ``marked`` are the frames that say so themselves; ``cells`` takes what the pictures are told by.
    """
    seen = same = longest = 0
    before: NDArray[np.uint8] | None = None
    try:
        for picture in pictures_of(path):
            if seen % EVERY == 0 and len(cells) < SAMPLES_MAX:
                cells.append(cells_of(picture))
            seen += 1
            same = same + 1 if before is not None and np.array_equal(before, picture) else 0
            longest, before = max(longest, same), picture
    except DatasetError as exc:
        yield DatasetFinding(where, str(exc))
        return
    if seen != count:
        yield DatasetFinding(where, f"it has {seen} pictures, and the episode {count} frames")
    longest = max(longest, _longest(marked))
    if longest >= FROZEN_S * fps:
        yield DatasetFinding(where, f"its picture stays the same for {longest / fps:.1f} s", wrong=False)
