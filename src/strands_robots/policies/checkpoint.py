"""Facts that a LeRobot checkpoint or dataset states, read without LeRobot.

``config.json`` has the features. ``policy_preprocessor.json`` and ``policy_postprocessor.json`` have the way in which
numbers are normalised, and name the files of their statistics; the headers of the safetensors files name and place what
they hold. Motor names, rate and robot are in the dataset alone. Format:
LeRobot 0.4 to 0.6.

``meta/info.json`` has robot, rate, names and pictures. The range of the numbers is in ``meta/stats.json`` (v2.0, v3.0),
or by episode in ``meta/episodes_stats.jsonl`` (v2.1).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from strands_robots.policies.decoding import ForeignDataError, decode_file, read_json
from strands_robots.utils import ValidationError, shown

STATE, ACTION, ENVIRONMENT = "observation.state", "action", "observation.environment_state"
HEADER_MAX, HEADER_ELEMENTS_MAX = 4 * 2**20, 200_000
"""Longest header of a weights file, in bytes and elements: some ten thousand tensors."""

Size = tuple[int, int, int]
"""Height, width and channels of a picture."""


class Spread(NamedTuple):
    """Lowest and highest value by place, as bounds or as quantiles."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    kind: str = "min"


VECTOR_MAX = 1024
"""Longest vector of statistics that is read."""

NEEDED_STATISTICS: Mapping[str, tuple[str, ...]] = {
    "IDENTITY": (),
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""Statistics that each way to normalise uses; of any other way they are not known."""


@dataclass(frozen=True)
class Statement:
    """Facts of a policy that one source states; None where it is silent.

    Attributes:
        source: the file, or the server's metadata.
        problem: why it cannot be used.
        cameras: size of each picture by the policy's key.
        state, environment, action: names in the policy's order; only their count where ``*_size`` alone is known.
        statistics: features whose statistics it has, as its way to normalise needs them.
        needed: features whose statistics it must have.
        state_range, action_range: lowest and highest value of each in the data.
        normalization: way to normalise by kind of feature, such as ``MEAN_STD`` of ``STATE``.
        recorded: size of each picture of the data by its key, renamed as the policy's.
        renamed: the policy's key of each picture that is renamed.
        robot: type of the robot that the data is of.
        language: it has to be told a task.
        kind: its type, such as ``act``.
    """

    source: str
    problem: str = ""
    cameras: Mapping[str, Size] | None = None
    state: tuple[str, ...] | None = None
    state_size: int | None = None
    environment: tuple[str, ...] | None = None
    environment_size: int | None = None
    action: tuple[str, ...] | None = None
    action_size: int | None = None
    rate: float | None = None
    chunk: int | None = None
    statistics: frozenset[str] | None = None
    needed: frozenset[str] = frozenset()
    state_range: Spread | None = None
    action_range: Spread | None = None
    normalization: Mapping[str, str] | None = None
    recorded: Mapping[str, Size] | None = None
    renamed: Mapping[str, str] | None = None
    robot: str = ""
    language: bool | None = None
    kind: str = ""


LANGUAGE_TYPES = frozenset({"smolvla", "pi0", "pi05", "pi0_fast", "groot", "xvla"})
"""Policy types that are told a task."""


def checkpoint_statements(directory: Path) -> list[Statement]:
    """Return what a checkpoint on disk states."""
    if not directory.is_dir():
        return [Statement(str(directory), "there is no such directory")]
    try:
        config = json_object(directory / "config.json")
    except ValueError as exc:
        return [Statement("config.json", str(exc))]
    weights = directory / "model.safetensors"
    return [
        _config(config),
        Statement(weights.name, _damage(weights)),
        _processor(directory, "policy_preprocessor.json", STATE),
        _processor(directory, "policy_postprocessor.json", ACTION),
    ]


def _config(config: Mapping[str, Any]) -> Statement:
    inputs, outputs = config.get("input_features"), config.get("output_features")
    if not isinstance(inputs, Mapping) or not isinstance(outputs, Mapping):
        return Statement("config.json", "it has no input_features and output_features")
    cameras: dict[str, Size] = {}
    for key, feature in inputs.items():
        shape = shape_of(feature)
        if str(key).startswith("observation.image") and len(shape) == 3:
            # Images are channel-first there.
            cameras[str(key)] = (shape[1], shape[2], shape[0])
    chunk = config.get("chunk_size", config.get("horizon"))
    names = config.get("action_feature_names")
    kind = str(config.get("type", ""))
    return Statement(
        "config.json",
        problem="" if kind else "it names no type",
        cameras=cameras,
        state_size=next(iter(shape_of(inputs.get(STATE))), None),
        environment_size=next(iter(shape_of(inputs.get(ENVIRONMENT))), None),
        action_size=next(iter(shape_of(outputs.get(ACTION))), None),
        action=tuple(map(str, names)) if isinstance(names, list) and names else None,
        chunk=chunk if isinstance(chunk, int) and not isinstance(chunk, bool) else None,
        language=kind in LANGUAGE_TYPES,
        kind=kind,
        normalization=_texts(config.get("normalization_mapping")) or None,
    )


def _processor(directory: Path, name: str, feature: str) -> Statement:
    """Return what a processor states of the statistics that it is for."""
    values: dict[str, tuple[float, ...]] = {}
    modes: dict[str, str] = {}
    renamed: dict[str, str] = {}
    try:
        for step in _steps(directory / name):
            settings = step.get("config")
            settings = settings if isinstance(settings, Mapping) else {}
            modes |= _texts(settings.get("norm_map"))
            renamed |= _texts(settings.get("rename_map"))
            if "state_file" in step:
                values |= _vectors(directory / Path(str(step["state_file"])).name)
    except ValueError as exc:
        return Statement(name, str(exc), statistics=frozenset(), needed=frozenset((STATE, ACTION)))
    has = {key: _of(values, key) for key in (STATE, ACTION)}
    present = frozenset(key for key, kinds in has.items() if _suffices(kinds, modes.get(KINDS[key], "")))
    own = next(filter(None, has[feature].values()), None)
    used = modes.get(KINDS[feature]) != "IDENTITY"
    return Statement(
        name,
        statistics=present,
        needed=frozenset((feature,)) if used else frozenset(),
        state_size=len(own) if own is not None and feature == STATE else None,
        action_size=len(own) if own is not None and feature == ACTION else None,
        state_range=bounds_of(has[STATE]) if feature == STATE else None,
        action_range=bounds_of(has[ACTION]),
        normalization=modes or None,
        renamed=renamed or None,
    )


KINDS = {STATE: "STATE", ACTION: "ACTION"}
"""Kind of each feature, as the way to normalise is listed by it."""


def bounds_of(kinds: Mapping[str, tuple[float, ...]]) -> Spread | None:
    """Return the range that statistics state, by bounds or by quantiles."""
    for low, high in (("min", "max"), ("q01", "q99")):
        if kinds.get(low) and len(kinds[low]) == len(kinds.get(high, ())):
            return Spread(kinds[low], kinds[high], low)
    return None


def _of(values: Mapping[str, tuple[float, ...]], feature: str) -> dict[str, tuple[float, ...]]:
    """Return the finite statistics of a feature; empty ones are not known."""
    found = {kind: values[f"{feature}.{kind}"] for kind in _STATISTICS if f"{feature}.{kind}" in values}
    return {kind: each for kind, each in found.items() if all(map(math.isfinite, each))}


_STATISTICS = tuple(dict.fromkeys(kind for kinds in NEEDED_STATISTICS.values() for kind in kinds))


def _suffices(kinds: Mapping[str, tuple[float, ...]], mode: str) -> bool:
    """Return True for the statistics that a way to normalise needs."""
    used = NEEDED_STATISTICS.get(mode)
    return bool(kinds) if used is None else all(kind in kinds for kind in used)


def _steps(path: Path) -> list[Mapping[str, Any]]:
    steps = json_object(path).get("steps", [])
    return [step for step in steps if isinstance(step, Mapping)] if isinstance(steps, list) else []


def _texts(given: object) -> dict[str, str]:
    return {str(key): str(each) for key, each in given.items()} if isinstance(given, Mapping) else {}


def _vectors(path: Path) -> dict[str, tuple[float, ...]]:
    """Return the vectors of a safetensors file; empty if of an unknown type.

    Raises:
        ValidationError: it is not whole.
    """
    problem = _damage(path)
    if problem and problem != NO_WEIGHTS:
        raise ValidationError(f"{path.name}: {problem}")
    found: dict[str, tuple[float, ...]] = {}
    with path.open("rb") as file:
        start = 8 + struct.unpack("<Q", file.read(8))[0]
        for name, tensor in _header(path).items():
            begin, end = (int(each) for each in tensor["data_offsets"])
            if len(tensor.get("shape", ())) > 1 or not 0 < end - begin <= VECTOR_MAX * 8:
                continue
            file.seek(start + begin)
            found[name] = _numbers(str(tensor.get("dtype")), file.read(end - begin))
    return found


def _numbers(kind: str, raw: bytes) -> tuple[float, ...]:
    """Return the numbers of a vector; none of a type that is not known."""
    if kind == "BF16":
        # The upper half of a 32-bit number.
        kind, raw = "F32", b"".join(b"\0\0" + raw[place : place + 2] for place in range(0, len(raw) - 1, 2))
    code = _CODES.get(kind)
    if code is None or len(raw) % struct.calcsize(code):
        return ()
    return tuple(float(each) for (each,) in struct.iter_unpack(f"<{code}", raw))


_CODES = {"F16": "e", "F32": "f", "F64": "d"}
"""Code in a ``struct`` of each type of number that is read."""


NO_WEIGHTS = "it holds no weights"


def _damage(path: Path) -> str:
    """Return why a safetensors file is not whole, or nothing."""
    try:
        header = _header(path)
        ends = [int(each["data_offsets"][1]) for each in header.values()]
    except (ValueError, TypeError, KeyError, IndexError) as exc:
        return str(exc) if isinstance(exc, ValueError) else "its header is damaged"
    with path.open("rb") as file:
        start = 8 + struct.unpack("<Q", file.read(8))[0]
    missing = start + max(ends, default=0) - path.stat().st_size
    if not ends:
        return NO_WEIGHTS
    return f"it lacks its last {missing} bytes" if missing > 0 else ""


def _header(path: Path) -> dict[str, Any]:
    """Return the tensors of a safetensors file: a length of 8 bytes, then JSON."""
    try:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > HEADER_MAX:
                raise ValidationError(f"{path.name} has a header of {length} bytes")
            header = decode_file(file.read(length), bytes_max=HEADER_MAX, elements_max=HEADER_ELEMENTS_MAX)
    except (OSError, struct.error, ForeignDataError) as exc:
        raise ValidationError(f"{path.name} cannot be read: {exc}") from None
    if not isinstance(header, dict):
        raise ValidationError(f"{path.name} has no header")
    return {name: each for name, each in header.items() if name != "__metadata__"}


def json_object(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file. Raises :class:`ValidationError` without one."""
    try:
        content = read_json(path)
    except (OSError, ValueError) as exc:
        raise ValidationError(f"it cannot be read: {exc}") from None
    if not isinstance(content, dict):
        raise ValidationError(f"it must be an object, not {shown(content)}")
    return content


def shape_of(feature: object) -> tuple[int, ...]:
    """Return the shape of a feature; empty where it states none."""
    shape = feature.get("shape") if isinstance(feature, Mapping) else None
    return tuple(int(each) for each in shape) if isinstance(shape, list) and all(map(_is_count, shape)) else ()


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


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
    found = [bounds_of(_episode_vectors(part.get(feature))) for part in parts]
    bounds = [each for each in found if each is not None]
    if not bounds or len(bounds) < len(found) or len({(len(each.low), each.kind) for each in bounds}) > 1:
        return None
    low = tuple(map(min, zip(*(each.low for each in bounds), strict=True)))
    high = tuple(map(max, zip(*(each.high for each in bounds), strict=True)))
    return Spread(low, high, bounds[0].kind)


def _episode_vectors(stats: object) -> dict[str, tuple[float, ...]]:
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
