"""Recordings as leaders: frames of a file, played at their recorded times.

A ``.csv`` file has a first line of names: ``t`` (seconds, rising) and action keys, in the follower's units. An empty
cell leaves its joint unchanged.

A LeRobot dataset (v2.1 and v3.0) has ``data/chunk-000/*.parquet`` with the columns ``action`` (a list of numbers),
``timestamp`` (seconds in its episode) and ``episode_index``, and the action's names in ``meta/info.json``,
``features.action.names``: a list, or a mapping of one list.
"""

from __future__ import annotations

import bisect
import csv
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from strands_robots.policies.base import Action
from strands_robots.policies.decoding import read_json
from strands_robots.teleoperators.leader import LeaderFinished
from strands_robots.utils import ValidationError, missing_extra, number, shown

Frame = tuple[float, Action]
"""Seconds since the start, and targets by action key."""

_TIME = "t"
_COLUMNS = ("action", "timestamp", "episode_index")
ROWS_MAX = 1_000_000
"""Frames of a file: five hours and a half at 50 Hz."""

VALUES_MAX = 64_000_000
BYTES_MAX = 2**30
BATCH_ROWS = 1024
LINE_MAX = 64 * 1024
"""Longest line of a .csv file, in characters."""


class RecordedLeader:
    """Leader that plays frames from its first ``get_action``, interpolated.

    Args:
        frames: at least one, in the order of their times.
        speed: factor of the recorded speed, above 0 and at most 10.
        now: monotonic seconds.

    Raises:
        ValidationError: no frame, times that do not rise, or ``speed`` outside its domain.
    """

    def __init__(self, frames: Sequence[Frame], speed: float = 1.0, now: Callable[[], float] = time.monotonic) -> None:
        if not frames:
            raise ValidationError("frames must hold at least one frame.")
        self._times = [seconds - frames[0][0] for seconds, _ in frames]
        if any(after <= before for before, after in zip(self._times, self._times[1:], strict=False)):
            raise ValidationError("frames must be in the order of their times, each later than the one before.")
        filled: Action = {}
        self._actions = [filled := {**filled, **action} for _, action in frames]
        self._speed = number("speed", speed, above=0, high=10)
        self._now = now
        self._started_at: float | None = None
        self.is_connected = True

    def get_action(self) -> Action:
        """Return the present targets.

        Raises:
            LeaderFinished: the recording is over.
        """
        if self._started_at is None:
            self._started_at = self._now()
        seconds = (self._now() - self._started_at) * self._speed
        if seconds > self._times[-1]:
            raise LeaderFinished("the recording is over")
        at = bisect.bisect_right(self._times, seconds) - 1
        before = self._actions[at]
        if at + 1 == len(self._times):
            return dict(before)
        share = (seconds - self._times[at]) / (self._times[at + 1] - self._times[at])
        after = self._actions[at + 1]
        return {key: value + share * (after[key] - value) for key, value in before.items()}


def read_frames(path: Path) -> list[Frame]:
    """Read the frames of a ``.csv`` file.

    Raises:
        ValidationError: no such file, another kind of file, or a malformed line, which the message names.
    """
    if path.suffix != ".csv":
        raise ValidationError(f"a recording must be a .csv, .parquet or .mcap file, not {shown(str(path))}.")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.reader(_lines(file, path.name))
            names = next(rows, [])
            if _TIME not in names or len(set(names)) != len(names) or len(names) < 2:
                raise ValidationError(f"the first line of {path.name} must name t and action keys, each once.")
            frames: list[Frame] = []
            for line, row in enumerate(rows, start=2):
                if row:
                    frames.append(_frame(names, row, f"line {line} of {path.name}"))
                check_length(len(frames), len(frames) * len(names))
            return frames
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror}.") from exc


def _lines(file: TextIO, name: str) -> Iterator[str]:
    while line := file.readline(LINE_MAX):
        if len(line) == LINE_MAX:
            raise ValidationError(f"a line of {name} has {LINE_MAX:,} characters or more.")
        yield line


def check_length(rows: int, values: int) -> None:
    """Refuse a recording of more frames or values than a robot's has.

    Raises:
        ValidationError: naming the bound.
    """
    _within("rows", rows, ROWS_MAX)
    _within("values", values, VALUES_MAX)


def _frame(names: list[str], row: list[str], place: str) -> Frame:
    if len(row) != len(names):
        raise ValidationError(f"{place} must have {len(names)} cells, not {len(row)}.")
    cells = dict(zip(names, row, strict=True))
    seconds = _cell(f"t in {place}", cells.pop(_TIME))
    return seconds, {name: _cell(f"{name} in {place}", cell) for name, cell in cells.items() if cell.strip()}


def _cell(name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise ValidationError(f"{name} must be a number, not {shown(cell)}.") from None
    return number(name, value)


def read_episode(path: Path, episode: str | None = None) -> list[Frame]:
    """Read the frames of one episode of a LeRobot dataset.

    Args:
        path: a data file inside its dataset.
        episode: its number; needed where the file holds several.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
        ValidationError: no such file, no action in it, no names for them, or no episode of that number.
    """
    try:
        from pyarrow import ArrowException  # noqa: PLC0415 - an extra
        from pyarrow.parquet import ParquetFile  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as exc:
        raise missing_extra("A recording in Parquet", "dataset") from exc
    try:
        with ParquetFile(path) as file:
            missing = [name for name in _COLUMNS if name not in file.schema_arrow.names]
            columns = {} if missing else _columns(file)
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror or exc}.") from exc
    except ArrowException as exc:
        raise ValidationError(f"{path.name} is no data file of a LeRobot dataset: {exc}.") from exc
    if missing:
        raise ValidationError(f"{path.name} is no data file of a LeRobot dataset: it has no column {missing[0]}.")
    wanted = _episode(path, columns["episode_index"], episode)
    names = _names(path)
    frames: list[Frame] = []
    rows = zip(columns["episode_index"], columns["timestamp"], columns["action"], strict=True)
    for row, (_, seconds, action) in enumerate(each for each in rows if each[0] == wanted):
        place = f"row {row} of episode {wanted} in {path.name}"
        if not isinstance(action, Sequence) or len(action) != len(names):
            raise ValidationError(f"action of {place} must have {len(names)} numbers ({', '.join(names)}).")
        values = {name: number(f"{name} in {place}", value) for name, value in zip(names, action, strict=True)}
        frames.append((number(f"timestamp of {place}", seconds), values))
    return frames


def _columns(file: Any) -> dict[str, list[Any]]:
    """Read the columns of a data file, a part at a time.

    A few kilobytes may state a billion rows of one value, so what the file states of itself is bounded first, and then
    what it really holds.

    Raises:
        ValidationError: it has more rows or values than a recording.
    """
    about = file.metadata
    groups = [about.row_group(number) for number in range(min(about.num_row_groups, ROWS_MAX))]
    parts = [group.column(number) for group in groups for number in range(group.num_columns)]
    parts = [part for part in parts if part.path_in_schema.partition(".")[0] in _COLUMNS]
    _within("rows", about.num_rows, ROWS_MAX)
    _within("values", sum(part.num_values for part in parts), VALUES_MAX)
    _within("bytes", sum(part.total_uncompressed_size for part in parts), BYTES_MAX)
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    values = 0
    for batch in file.iter_batches(batch_size=BATCH_ROWS, columns=list(_COLUMNS)):
        values += batch.nbytes // 8
        _within("values", values, VALUES_MAX)
        for name, column in batch.to_pydict().items():
            columns[name] += column
        _within("rows", len(columns[_COLUMNS[0]]), ROWS_MAX)
    return columns


def _within(what: str, count: int, most: int) -> None:
    if not 0 <= count <= most:
        raise ValidationError(f"the recording has {count:,} {what}, and may have {most:,} at most.")


def _episode(path: Path, column: list[Any], requested: str | None) -> int:
    known = sorted(set(column))
    if requested is None and len(known) == 1:
        return int(known[0])
    if requested is not None and requested.isdecimal() and int(requested) in known:
        return int(requested)
    choices = f"{known[0]} to {known[-1]}" if known else "none"
    raise ValidationError(f"device must be an episode of {path.name} ({choices}), not {shown(requested)}.")


def _names(path: Path) -> list[str]:
    info = next((each / "meta" / "info.json" for each in path.resolve().parents if (each / "meta").is_dir()), None)
    try:
        content = read_json(info) if info is not None else {}
        names = content["features"]["action"]["names"]
    except (OSError, ValueError, KeyError, TypeError) as exc:
        raise ValidationError(f"{path.name} needs meta/info.json of its dataset, which names the actions.") from exc
    if isinstance(names, Mapping) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not names or len(set(names)) != len(names):
        raise ValidationError(f"features.action.names of {info} must be a list of names, not {shown(names)}.")
    return [str(name) for name in names]
