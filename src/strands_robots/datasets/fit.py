"""Check of a dataset against a robot: its names, and values it cannot have."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.bounded_json import json_object
from strands_robots.datasets.check import DatasetFinding
from strands_robots.datasets.layout import INFO_BYTES, STATS, DatasetError, DatasetInfo
from strands_robots.datasets.recorded import ACTION, STATE
from strands_robots.policies.base import Ranges
from strands_robots.recording.file import units_in
from strands_robots.utils import ValidationError, shown

OUTSIDE = 0.05
"""Share of a joint's range by which a value may be beyond it: a real arm reads past its stops."""


@dataclass(frozen=True, slots=True)
class RobotJoints:
    """Joints that a robot observes and is told, their ranges and units."""

    name: str
    observed: tuple[str, ...]
    told: tuple[str, ...]
    ranges: Ranges
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, features: Mapping[str, Any], part: str = "") -> RobotJoints:
        """Read the answer of ``getFeatures``.

        Args:
            name: of the robot, in messages.
            features: the answer, of a stranger perhaps.
            part: which robot of a world; empty for the only one.

        Raises:
            ValidationError: it states no joints, or several robots and none is named.
        """
        units, robots = units_in(features, part), features.get("robots")
        if isinstance(robots, Mapping):
            if (part or len(robots) > 1) and part not in robots:
                known = ", ".join(map(str, robots))
                raise ValidationError(f"--robot must name one of the world's robots ({known}), not {shown(part)}.")
            chosen = robots[part] if part else next(iter(robots.values()), None)
            features = chosen if isinstance(chosen, Mapping) else {}
            stated: Mapping[str, Any] = {**_mapping(features.get("joints")), **_mapping(features.get("actuators"))}
        else:
            stated = _mapping(features.get("ranges"))
        observed, told = (_numbers(features.get(f"{each}_features")) for each in ("observation", "action"))
        if not observed or not told:
            raise ValidationError(f"{name} states no joints or no actions.")
        ranges = {str(key): found for key, value in stated.items() if (found := _range(value)) is not None}
        return cls(name, observed, told, ranges, units)


def robot_findings(folder: Path, info: DatasetInfo, robot: RobotJoints) -> Iterator[DatasetFinding]:
    """Yield what of a dataset does not fit a robot.

    Args:
        folder: of the dataset.
        info: of the dataset.
        robot: that it is held against.

    Raises:
        DatasetError: its statistics cannot be read.
    """
    try:
        statistics = json_object((folder / STATS).read_bytes(), INFO_BYTES)
    except (OSError, ValueError) as exc:
        raise DatasetError(f"{STATS} cannot be read: {exc}") from exc
    for key, known in ((STATE, robot.observed), (ACTION, robot.told)):
        names = info.features[key].names if key in info.features else ()
        if lacking := [name for name in known if name not in names]:
            yield DatasetFinding(key, f"it has no {', '.join(lacking)}, which {robot.name} has")
        if strange := [name for name in names if name not in known]:
            yield DatasetFinding(key, f"{robot.name} has no {', '.join(strange)}")
        found = _mapping(statistics.get(key))
        for index, name in enumerate(names):
            unit, its = (info.features[key].units or ("",) * len(names))[index], robot.units.get(name, "")
            if unit and its and unit != its:
                yield DatasetFinding(key, f"{name} is in {unit}, and of {robot.name} in {its}")
                continue
            bounds, seen = robot.ranges.get(name), _seen(found, index)
            if bounds is None or seen is None:
                continue
            spare = OUTSIDE * (bounds[1] - bounds[0])
            if seen[0] < bounds[0] - spare or seen[1] > bounds[1] + spare:
                takes = f"{robot.name} takes {bounds[0]:.4g} to {bounds[1]:.4g}"
                said = f"{name} is {seen[0]:.4g} to {seen[1]:.4g}, and {takes}; is it of another unit?"
                yield DatasetFinding(key, said)


def _seen(statistics: Mapping[str, Any], index: int) -> tuple[float, float] | None:
    lowest, highest = statistics.get("min"), statistics.get("max")
    if not isinstance(lowest, list) or not isinstance(highest, list) or not index < len(lowest) == len(highest):
        return None
    return _range([lowest[index], highest[index]])


def _range(value: object) -> tuple[float, float] | None:
    if not isinstance(value, list | tuple) or len(value) != 2:
        return None
    low, high = value
    if any(isinstance(each, bool) or not isinstance(each, int | float) or not math.isfinite(each) for each in value):
        return None
    return float(low), float(high)


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _numbers(features: object) -> tuple[str, ...]:
    """Return the names of features that are numbers; a list has no others."""
    if isinstance(features, list | tuple):
        return tuple(str(each) for each in features)
    return tuple(str(key) for key, kind in _mapping(features).items() if not isinstance(kind, list | tuple))
