"""A LeRobot dataset's ``.parquet`` file as frames that lead.

Layout (LeRobot dataset v2.1 and v3.0): ``data/chunk-000/*.parquet`` with the columns ``action`` (a list of numbers),
``timestamp`` (seconds in its episode) and ``episode_index``; the action's names are in ``meta/info.json`` of the same
dataset, ``features.action.names``: a list, or a mapping of one list.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from strands_robots.leaders.recorded import Frame
from strands_robots.utils import ValidationError, missing_extra, number, shown

_COLUMNS = ("action", "timestamp", "episode_index")


def read_episode(path: Path, episode: str | None = None) -> list[Frame]:
    """The frames of one episode.

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
            columns: dict[str, list[Any]] = {} if missing else file.read(columns=list(_COLUMNS)).to_pydict()
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
        where = f"row {row} of episode {wanted} in {path.name}"
        if not isinstance(action, Sequence) or len(action) != len(names):
            raise ValidationError(f"action of {where} must have {len(names)} numbers ({', '.join(names)}).")
        values = {name: number(f"{name} in {where}", value) for name, value in zip(names, action, strict=True)}
        frames.append((number(f"timestamp of {where}", seconds), values))
    return frames


def _episode(path: Path, column: list[Any], asked: str | None) -> int:
    known = sorted(set(column))
    if asked is None and len(known) == 1:
        return int(known[0])
    if asked is not None and asked.isdecimal() and int(asked) in known:
        return int(asked)
    held = f"{known[0]} to {known[-1]}" if known else "none"
    raise ValidationError(f"device must be an episode of {path.name} ({held}), not {shown(asked)}.")


def _names(path: Path) -> list[str]:
    """What the numbers of an action are called."""
    info = next((each / "meta" / "info.json" for each in path.resolve().parents if (each / "meta").is_dir()), None)
    try:
        told = json.loads(info.read_text(encoding="utf-8")) if info is not None else {}
        names = told["features"]["action"]["names"]
    except (OSError, ValueError, KeyError, TypeError) as exc:
        raise ValidationError(f"{path.name} needs meta/info.json of its dataset, which names the actions.") from exc
    if isinstance(names, Mapping) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not names or len(set(names)) != len(names):
        raise ValidationError(f"features.action.names of {info} must be a list of names, not {shown(names)}.")
    return [str(name) for name in names]
