"""Facts that a LeRobot checkpoint and its dataset state, read without LeRobot.

``config.json`` has the features, ``policy_preprocessor.json`` and ``policy_postprocessor.json`` name the files of their
statistics, and the headers of the safetensors files name and place what they hold. Motor names, rate and robot are in
the dataset's ``meta/info.json`` alone. Format: LeRobot 0.4 to 0.6.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strands_robots.policies.decoding import ForeignDataError, decode_file, read_json
from strands_robots.utils import ValidationError, shown

STATE, ACTION, ENVIRONMENT = "observation.state", "action", "observation.environment_state"
HEADER_MAX, HEADER_ELEMENTS_MAX = 4 * 2**20, 200_000
"""Longest header of a weights file, in bytes and elements: some ten thousand tensors."""

Size = tuple[int, int, int]
"""Height, width and channels of a picture."""


@dataclass(frozen=True)
class Statement:
    """Facts of a policy that one source states; None where it is silent.

    Attributes:
        source: the file, or the server's metadata.
        problem: why it cannot be used.
        cameras: size of each picture by the policy's key.
        state, environment, action: names in the policy's order; only their count where ``*_size`` alone is known.
        statistics: features whose statistics it has.
        state_range: lowest and highest value of each state in the data.
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
    state_range: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    language: bool | None = None
    kind: str = ""


LANGUAGE_TYPES = frozenset({"smolvla", "pi0", "pi05", "pi0_fast", "groot", "xvla"})
"""Policy types that are told a task."""


def checkpoint_statements(directory: Path) -> list[Statement]:
    """Return what a checkpoint on disk states."""
    if not directory.is_dir():
        return [Statement(str(directory), "there is no such directory")]
    try:
        config = _object(directory / "config.json")
    except ValueError as exc:
        return [Statement("config.json", str(exc))]
    weights = directory / "model.safetensors"
    return [_config(config), Statement(weights.name, _damage(weights)), _statistics(directory)]


def dataset_statement(directory: Path) -> Statement:
    """Return what the ``meta/info.json`` of a dataset states."""
    try:
        info = _object(directory / "meta" / "info.json")
    except ValueError as exc:
        return Statement("info.json", str(exc))
    features = info.get("features")
    features = features if isinstance(features, Mapping) else {}
    fps = info.get("fps")
    lows, highs = (_stats(directory).get(bound) for bound in ("min", "max"))
    return Statement(
        "info.json",
        state=_names(features.get(STATE)),
        environment=_names(features.get(ENVIRONMENT)),
        action=_names(features.get(ACTION)),
        rate=float(fps) if isinstance(fps, int | float) and not isinstance(fps, bool) and fps > 0 else None,
        state_range=(lows, highs) if lows and highs and len(lows) == len(highs) else None,
    )


def _config(config: Mapping[str, Any]) -> Statement:
    inputs, outputs = config.get("input_features"), config.get("output_features")
    if not isinstance(inputs, Mapping) or not isinstance(outputs, Mapping):
        return Statement("config.json", "it has no input_features and output_features")
    cameras: dict[str, Size] = {}
    for key, feature in inputs.items():
        shape = _shape(feature)
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
        state_size=next(iter(_shape(inputs.get(STATE))), None),
        environment_size=next(iter(_shape(inputs.get(ENVIRONMENT))), None),
        action_size=next(iter(_shape(outputs.get(ACTION))), None),
        action=tuple(map(str, names)) if isinstance(names, list) and names else None,
        chunk=chunk if isinstance(chunk, int) and not isinstance(chunk, bool) else None,
        language=kind in LANGUAGE_TYPES,
        kind=kind,
    )


def _statistics(directory: Path) -> Statement:
    """Return the features with statistics, in both processors."""
    found: set[str] = set()
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        try:
            steps = _object(directory / name).get("steps", [])
            files = [step["state_file"] for step in steps if isinstance(step, Mapping) and "state_file" in step]
            for each in files:
                for tensor in _header(directory / Path(str(each)).name):
                    feature, _, kind = tensor.rpartition(".")
                    found |= {feature} if kind in ("mean", "std", "min", "max", "q01", "q99") else set()
        except ValueError as exc:
            return Statement(name, str(exc), statistics=frozenset())
    return Statement("the processors", statistics=frozenset(found))


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
        return "it holds no weights"
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


def _object(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except (OSError, ValueError) as exc:
        raise ValidationError(f"it cannot be read: {exc}") from None
    if not isinstance(content, dict):
        raise ValidationError(f"it must be an object, not {shown(content)}")
    return content


def _shape(feature: object) -> tuple[int, ...]:
    shape = feature.get("shape") if isinstance(feature, Mapping) else None
    return tuple(int(each) for each in shape) if isinstance(shape, list) and all(map(_is_count, shape)) else ()


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _names(feature: object) -> tuple[str, ...] | None:
    names = feature.get("names") if isinstance(feature, Mapping) else None
    if isinstance(names, Mapping) and len(names) == 1:
        # Older data sets: {"motors": [...]}.
        names = next(iter(names.values()))
    return tuple(map(str, names)) if isinstance(names, list) and names else None


def _stats(directory: Path) -> dict[str, tuple[float, ...]]:
    """Return the statistics of the state, by kind; none where the file has none."""
    try:
        state = _object(directory / "meta" / "stats.json").get(STATE)
    except ValueError:
        return {}
    kinds = state if isinstance(state, Mapping) else {}
    return {
        str(kind): tuple(map(float, values))
        for kind, values in kinds.items()
        if isinstance(values, list) and all(isinstance(v, int | float) and math.isfinite(v) for v in values)
    }
