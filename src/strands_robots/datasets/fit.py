"""Check of a dataset against a robot or a policy's profile."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from strands_robots.bounded_json import json_object
from strands_robots.datasets.check import DatasetFinding
from strands_robots.datasets.layout import INFO_BYTES, STATS, DatasetError, DatasetInfo, Feature
from strands_robots.datasets.recorded import ACTION, IMAGES, STATE
from strands_robots.policies.base import Ranges
from strands_robots.policies.check import PROFILE, CheckRow, compared, of, unanswered
from strands_robots.policies.profiles import Profile
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


DATASET = "dataset"
"""Owner of values of a dataset, in the rows of a check."""


def profile_rows(profile: Profile, info: DatasetInfo) -> Iterator[CheckRow]:
    """Yield the rows of a policy's profile against a dataset: names, units, rate, cameras.

    Args:
        profile: of the policy.
        info: of the dataset.
    """
    for key, names in ((STATE, profile.state), (ACTION, profile.action)):
        feature = info.features.get(key, Feature("float32"))
        mine, its = (
            of(", ".join(each) or "none", owner) for each, owner in ((names, PROFILE), (feature.names, DATASET))
        )
        change = f"name the joints of {key} as the dataset does, in its order"
        yield compared(f"names of {key}", mine, its, tuple(names) == feature.names, change)
        yield _units_row(profile, key, dict(zip(feature.names, feature.units, strict=False)))
    if profile.rate is None:
        yield unanswered("rate of the dataset", robot=of(f"{info.fps} Hz", DATASET), change=f"set rate = {info.fps}")
    else:
        rates = of(f"{profile.rate:g} Hz", PROFILE), of(f"{info.fps} Hz", DATASET)
        yield compared("rate of the dataset", *rates, profile.rate == info.fps, f"set rate = {info.fps}")
    yield from _camera_rows(profile, info)


def _units_row(profile: Profile, key: str, units: Mapping[str, str]) -> CheckRow:
    keys = profile.state if key == STATE else profile.action
    pairs = [(name, profile.unit(name) or "", units.get(name, "")) for name in keys]
    both = [(name, mine, its) for name, mine, its in pairs if mine and its]
    if not both:
        return unanswered(f"units of {key}", robot=of("not stated", DATASET), change="look at its ranges")
    other = [each for each in both if each[1] != each[2]]
    shown_rows = other or both[:1]
    mine, its = (", ".join(f"{each[0]} in {each[side]}" for each in shown_rows) for side in (1, 2))
    return compared(f"units of {key}", of(mine, PROFILE), of(its, DATASET), not other, "state the units of the data")


def _camera_rows(profile: Profile, info: DatasetInfo) -> Iterator[CheckRow]:
    seen = set()
    for each in profile.cameras:
        names = (each.key, IMAGES + each.camera.replace("/", "."))
        name = next((name for name in names if name in info.videos), "")
        question, have = f"pictures of {each.camera}", of(", ".join(info.videos) or "no pictures", DATASET)
        if not name:
            yield compared(question, of(each.key, PROFILE), have, fits=False, change="name a camera of the dataset")
            continue
        seen.add(name)
        size, its = each.size, info.videos[name].shape[:2]
        if size is not None and each.crop is None and size != its:
            change = "look whether it was trained on pictures that were resized so"
            mine, theirs = (f"{height}x{width}" for height, width in (size, its))
            yield unanswered(question, of(mine, PROFILE), of(theirs, DATASET), change)
        else:
            yield compared(question, of(each.key, PROFILE), of(name, DATASET), fits=True, change="")
    for name in sorted(info.videos.keys() - seen):
        yield unanswered(f"pictures of {name}", of("no such picture", PROFILE), of(name, DATASET), "it sees none of it")


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
