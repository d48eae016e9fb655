"""Policy profiles: an operator's description of each trained policy.

A caller names a profile as ``policy_provider``; it never names a path or a host. ``docs/policies.md`` has the file.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from strands_robots import settings
from strands_robots.utils import (
    ValidationError,
    choice,
    duration,
    flag,
    identifier,
    mapping,
    number,
    shown,
    text,
    whole,
)

UNITS = ("degrees", "radians", "normalized", "percent", "metres")
LAYOUTS = ("libero", "droid", "aloha", "n1.5", "n1.6", "n1.6-flat")
"""Forms of a server's observation: the first three of openpi, the others of GR00T."""
FLIPS = ("none", "180", "horizontal", "vertical")
ASYNC = "lerobot_async"
"""Provider whose server loads what the profile tells it."""
CONFIRMABLE = ("units", "rate", "image size", "robot type")
"""Facts that a profile may declare to be right although nothing states them."""

IMAGES = "observation.images."
"""Prefix of LeRobot's keys of pictures."""

KEYS_MAX = 64
RATE_MAX = 2000.0


@dataclass(frozen=True)
class CameraMap:
    """One camera of the robot, and the picture of the policy that it becomes.

    Attributes:
        camera: the robot's name of it.
        key: the policy's, as ``observation.images.front``.
        size: height and width in pixels after crop and resize; None as the camera gives it.
        crop: x, y, width and height in the camera's picture; None for all of it.
        flip: none, 180, horizontal or vertical.
    """

    camera: str
    key: str
    size: tuple[int, int] | None = None
    crop: tuple[int, int, int, int] | None = None
    flip: str = "none"

    @property
    def short_key(self) -> str:
        """Key under which :class:`ProfiledPolicy` hands the picture on."""
        return self.key.removeprefix(IMAGES)


@dataclass(frozen=True)
class Profile:
    """One policy, and how it meets the robot.

    Attributes:
        provider: the kind of policy, such as ``lerobot_local`` or ``remote``.
        checkpoint: a local directory, or ``org/name`` on the Hub; empty for a server, but for one of LeRobot's, which
            loads it.
        policy_type: of the checkpoint that a server of LeRobot's loads, such as ``act``.
        url: of the server, ``ws://host:port``; empty for a checkpoint.
        dataset: directory of the dataset that it was trained on, for what ``meta/info.json`` states.
        state: the robot's observation keys in the policy's order.
        action: the robot's action keys in the policy's order.
        environment: observation keys of what is around the robot, in the policy's order.
        units: unit of the policy's numbers by key; the entry ``""`` is that of all others.
        rate: control steps a second at which the data was recorded; None where nothing states it.
        horizon: actions that are played of each answer; None for all.
        rtc: make each chunk go on from the last one, where the checkpoint can.
        layout: form of a server's observation, of :data:`LAYOUTS`; empty for the provider's first.
        parts: the keys in each of a GR00T server's parts, in its order.
        task: the text that the policy was trained with; empty takes the caller's instruction.
        first_deadline_s, deadline_s: longest time until the policy is ready, and of each later answer.
        max_speed: whole ranges that a joint may cross in a second; None for no bound.
        state_margin: part of the statistics' range by which the robot may be outside of it at the start.
        confirmed: of :data:`CONFIRMABLE`, what the operator vouches for.
    """

    name: str
    provider: str
    state: tuple[str, ...]
    action: tuple[str, ...]
    checkpoint: str = ""
    policy_type: str = ""
    url: str = ""
    token_file: str = ""
    dataset: str = ""
    environment: tuple[str, ...] = ()
    cameras: tuple[CameraMap, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    rate: float | None = None
    chunk: int | None = None
    horizon: int | None = None
    rtc: bool = False
    layout: str = ""
    parts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    task: str = ""
    device: str = ""
    first_deadline_s: float = 120.0
    deadline_s: float = 1.0
    max_speed: float | None = 1.0
    state_margin: float = 0.2
    confirmed: frozenset[str] = frozenset()

    def unit(self, key: str) -> str | None:
        """Return the policy's unit of a key, or None where the profile states none."""
        return self.units.get(key, self.units.get(""))

    def loop_options(self, options: Mapping[str, Any], hz: float) -> dict[str, Any]:
        """Return the options of the loop; a caller may repeat host, port and checkpoint.

        Args:
            options: the caller's.
            hz: the robot's rate, at which it is controlled.

        Raises:
            ValidationError: an option that differs from the profile, or that is the profile's alone.
        """
        address = urlsplit(self.url)
        own = {
            "policy_host": address.hostname or "localhost",
            "policy_port": address.port or 0,
            "pretrained_name_or_path": self.checkpoint,
        }
        for option, value in options.items():
            if option == "n_steps" or (option == "policy_port" and value == 0):
                continue
            if option == "control_frequency" and value == hz:
                continue
            if option not in own:
                raise ValidationError(f"{option} is set by the profile {self.name} alone.")
            if value != own[option]:
                raise ValidationError(
                    f"{option} must be {own[option]!r}, as in the profile {self.name}, not {shown(value)}."
                )
        steps = {"n_steps": options["n_steps"]} if "n_steps" in options else {}
        return {**steps, "control_frequency": hz}


def load_profiles(path: Path) -> dict[str, Profile]:
    """Read the profiles of a file, by name.

    Raises:
        ValidationError: it cannot be read, or naming profile, entry, value and domain.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as exc:
        why = exc.strerror if isinstance(exc, OSError) else exc
        raise ValidationError(f"the policies file {path} cannot be read: {why}.") from exc
    return {identifier(f"{path.name}: a profile's name", name): _profile(name, table) for name, table in tables.items()}


def profiles() -> Mapping[str, Profile]:
    """Return the profiles of ``STRANDS_POLICIES``, by name; none where it is unset.

    Raises:
        ValidationError: as :func:`load_profiles`.
    """
    path = settings.raw("STRANDS_POLICIES")
    return _profiles_of(path) if path else {}


@lru_cache(maxsize=4)
def _profiles_of(path: str) -> Mapping[str, Profile]:
    return load_profiles(Path(path).expanduser())


def _profile(name: str, given: object) -> Profile:
    where = f"profile {name}"
    entries = mapping(where, given)
    known = {each: check for each, check in _ENTRIES.items() if each in entries}
    unknown = sorted(entries.keys() - _ENTRIES.keys())
    if unknown:
        raise ValidationError(f"{where} has no entry {', '.join(map(shown, unknown))}; it has {', '.join(_ENTRIES)}.")
    for needed in ("provider", "state", "action"):
        if needed not in entries:
            raise ValidationError(f"{where} needs {needed}.")
    checked = {each: check(f"{where}: {each}", entries[each]) for each, check in known.items()}
    profile = Profile(name, **checked)
    if profile.provider == ASYNC and not (profile.url and profile.checkpoint and profile.policy_type):
        raise ValidationError(f"{where} needs url, checkpoint and policy_type: the server loads what it is told.")
    if profile.provider != ASYNC and (profile.policy_type or bool(profile.checkpoint) == bool(profile.url)):
        raise ValidationError(f"{where} needs either checkpoint or url; policy_type is of provider {ASYNC} alone.")
    keys = [camera.key for camera in profile.cameras]
    if len(keys) != len(set(keys)):
        raise ValidationError(f"{where}: cameras must have a key each, not {', '.join(keys)}.")
    if profile.chunk is not None and profile.horizon is not None and profile.horizon > profile.chunk:
        raise ValidationError(f"{where}: horizon must be at most chunk, {profile.chunk}, not {profile.horizon}.")
    return profile


def _provider(name: str, value: object) -> str:
    provider = identifier(name, value)
    if provider == "mock":
        raise ValidationError(f"{name} must be a trained policy, not 'mock'.")
    return provider


def _order(name: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not 1 <= len(value) <= KEYS_MAX:
        raise ValidationError(
            f"{name} must be a list of 1 to {KEYS_MAX} keys, in the policy's order, not {shown(value)}."
        )
    keys = tuple(text(f"{name}[{index}]", key, longest=128) for index, key in enumerate(value))
    if len(set(keys)) != len(keys):
        raise ValidationError(f"{name} must name each key once.")
    return keys


def _units(name: str, value: object) -> dict[str, str]:
    if isinstance(value, str):
        return {"": choice(name, value, UNITS)}
    flat: dict[str, object] = {}
    for key, unit in mapping(name, value).items():
        # Unquoted, grip.pos = "percent" is a table in TOML.
        flat |= {f"{key}.{rest}": each for rest, each in unit.items()} if isinstance(unit, dict) else {key: unit}
    return {"" if key == "default" else key: choice(f"{name}.{key}", unit, UNITS) for key, unit in flat.items()}


def _url(name: str, value: object) -> str:
    url = text(name, value, longest=500)
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = -1
    if parts.scheme not in ("ws", "wss", "tcp", "grpc") or not parts.hostname or port == -1 or parts.username:
        raise ValidationError(f"{name} must be ws://, wss://, tcp:// or grpc:// with a host, not {shown(value)}.")
    return url


def _cameras(name: str, value: object) -> tuple[CameraMap, ...]:
    return tuple(_camera(f"{name}.{camera}", camera, each) for camera, each in mapping(name, value).items())


def _camera(name: str, camera: str, value: object) -> CameraMap:
    entries = mapping(name, value)
    unknown = sorted(entries.keys() - {"key", "size", "crop", "flip"})
    if unknown or "key" not in entries:
        raise ValidationError(f"{name} takes key, size, crop and flip, and needs key; not {', '.join(entries)}.")
    height, width = _wholes(f"{name}.size", entries["size"], 2, 1) if "size" in entries else (0, 0)
    crop = _wholes(f"{name}.crop", entries["crop"], 4, 0) if "crop" in entries else None
    if crop is not None and not (crop[2] and crop[3]):
        raise ValidationError(f"{name}.crop must be x, y, width and height, both above 0, not {shown(list(crop))}.")
    return CameraMap(
        camera,
        text(f"{name}.key", entries["key"], longest=200),
        (height, width) if height else None,
        None if crop is None else (crop[0], crop[1], crop[2], crop[3]),
        choice(f"{name}.flip", entries.get("flip", "none"), FLIPS),
    )


def _wholes(name: str, value: object, count: int, low: int) -> tuple[int, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise ValidationError(f"{name} must be {count} pixels, not {shown(value)}.")
    return tuple(whole(f"{name}[{index}]", each, low=low, high=10_000) for index, each in enumerate(value))


def _confirmed(name: str, value: object) -> frozenset[str]:
    if not isinstance(value, list):
        raise ValidationError(f"{name} must be a list of {', '.join(CONFIRMABLE)}, not {shown(value)}.")
    return frozenset(choice(name, each, CONFIRMABLE) for each in value)


def _text(longest: int) -> Callable[[str, object], str]:
    return lambda name, value: text(name, value, longest=longest)


_ENTRIES: dict[str, Callable[[str, object], Any]] = {
    "provider": _provider,
    "checkpoint": _text(4096),
    "policy_type": identifier,
    "url": _url,
    "token_file": _text(4096),
    "dataset": _text(4096),
    "cameras": _cameras,
    "state": _order,
    "action": _order,
    "environment": _order,
    "units": _units,
    "rate": lambda name, value: number(name, value, low=0.1, high=RATE_MAX),
    "chunk": lambda name, value: whole(name, value, low=1, high=10_000),
    "horizon": lambda name, value: whole(name, value, low=1, high=10_000),
    "rtc": flag,
    "layout": lambda name, value: choice(name, value, LAYOUTS),
    "parts": lambda name, value: {part: _order(f"{name}.{part}", keys) for part, keys in mapping(name, value).items()},
    "task": _text(2000),
    "device": _text(64),
    "first_deadline_s": duration,
    "deadline_s": duration,
    "max_speed": lambda name, value: number(name, value, above=0, high=10),
    "state_margin": lambda name, value: number(name, value, low=0, high=10),
    "confirmed": _confirmed,
}
"""Checks of the entries of a profile."""
