"""Facts that a LeRobot dataset states, read without LeRobot.

``meta/info.json`` has robot, rate, names and pictures. The range of the numbers is in ``meta/stats.json`` (v2.0, v3.0),
or by episode in ``meta/episodes_stats.jsonl`` (v2.1).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from strands_robots.policies.checkpoint import (
    ACTION,
    ENVIRONMENT,
    STATE,
    Size,
    Spread,
    Statement,
    bounds_of,
    json_object,
    shape_of,
)
from strands_robots.policies.decoding import ForeignDataError, decode_file
from strands_robots.utils import ValidationError

EPISODES_MAX = 100_000
"""Most episodes whose statistics are read."""

LINE_MAX = 2**18
"""Longest line of an episode's statistics, in bytes."""


def dataset_statements(directory: Path) -> list[Statement]:
    """Return what a dataset on disk states."""
    try:
        info = json_object(directory / "meta" / "info.json")
    except ValueError as exc:
        return [Statement("info.json", str(exc))]
    features = info.get("features")
    features = features if isinstance(features, Mapping) else {}
    fps, robot = info.get("fps"), info.get("robot_type")
    stated = Statement(
        "info.json",
        state=_names(features.get(STATE)),
        state_size=_size(features.get(STATE)),
        environment=_names(features.get(ENVIRONMENT)),
        action=_names(features.get(ACTION)),
        action_size=_size(features.get(ACTION)),
        rate=float(fps) if isinstance(fps, int | float) and not isinstance(fps, bool) and fps > 0 else None,
        recorded={str(key): size for key, each in features.items() if (size := _picture(each)) is not None},
        robot=robot if isinstance(robot, str) and robot != "unknown" else "",
    )
    return [stated, *_ranges(directory / "meta")]


def _ranges(folder: Path) -> Iterator[Statement]:
    """Yield what the statistics state, of the whole or by episode."""
    for name in ("stats.json", "episodes_stats.jsonl"):
        path = folder / name
        if not path.is_file():
            continue
        try:
            parts = [json_object(path)] if path.suffix == ".json" else list(_episodes(path))
        except (OSError, ValueError) as exc:
            yield Statement(name, f"it cannot be read: {exc}")
            return
        state, action = (_whole(parts, feature) for feature in (STATE, ACTION))
        if state is not None or action is not None:
            yield Statement(name, state_range=state, action_range=action)
            return


def _episodes(path: Path) -> Iterator[Mapping[str, object]]:
    """Yield the statistics of each episode.

    Raises:
        ForeignDataError: a line has none.
    """
    with path.open("rb") as file:
        for number in range(EPISODES_MAX + 1):
            line = file.readline(LINE_MAX + 1)
            if not line:
                return
            if number == EPISODES_MAX:
                raise ValidationError(f"it has more than {EPISODES_MAX:,} episodes")
            if line.strip():
                episode = decode_file(line, bytes_max=LINE_MAX)
                stats = episode.get("stats") if isinstance(episode, dict) else None
                if not isinstance(stats, dict):
                    raise ForeignDataError("a line has no stats")
                yield stats


def _whole(parts: list[Mapping[str, object]] | list[dict[str, object]], feature: str) -> Spread | None:
    """Return the range over all parts; None unless all state it alike."""
    found = [bounds_of(_vectors(part.get(feature))) for part in parts]
    bounds = [each for each in found if each is not None]
    if not bounds or len(bounds) < len(found) or len({(len(each.low), each.kind) for each in bounds}) > 1:
        return None
    low = tuple(map(min, zip(*(each.low for each in bounds), strict=True)))
    high = tuple(map(max, zip(*(each.high for each in bounds), strict=True)))
    return Spread(low, high, bounds[0].kind)


def _vectors(stats: object) -> dict[str, tuple[float, ...]]:
    kinds = stats if isinstance(stats, Mapping) else {}
    return {
        str(kind): tuple(map(float, values))
        for kind, values in kinds.items()
        if isinstance(values, list) and all(isinstance(v, int | float) and math.isfinite(v) for v in values)
    }


def _names(feature: object) -> tuple[str, ...] | None:
    names = feature.get("names") if isinstance(feature, Mapping) else None
    if isinstance(names, Mapping) and len(names) == 1:
        # Older data sets: {"motors": [...]}.
        names = next(iter(names.values()))
    return tuple(map(str, names)) if isinstance(names, list) and names else None


def _size(feature: object) -> int | None:
    shape = shape_of(feature)
    return shape[0] if len(shape) == 1 else None


def _picture(feature: object) -> Size | None:
    """Return the size of a picture; None for another feature."""
    shape = shape_of(feature)
    if not isinstance(feature, Mapping) or feature.get("dtype") not in ("video", "image") or len(shape) != 3:
        return None
    names = feature.get("names")
    first = isinstance(names, list) and bool(names) and str(names[0]).startswith("channel")
    return (shape[1], shape[2], shape[0]) if first else (shape[0], shape[1], shape[2])
