"""Saved places of arms: joints in degrees by place, one file an arm in the state directory."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

from strands_robots.state_files import StateFileError, adopt, make_private, read_private, state_dir
from strands_robots.utils import ValidationError, identifier, mapping, number

Places = dict[str, dict[str, float]]

PLACES_MAX = 256
"""Most places of one arm."""

DEGREES_MAX = 7200.0


def place_file(arm: str) -> Path:
    """Return the file of an arm's places, named for a person and distinct by a hash."""
    readable = re.sub(r"[^A-Za-z0-9._-]+", "_", arm)[:64]
    return state_dir() / "places" / f"{readable}-{hashlib.sha256(arm.encode()).hexdigest()[:16]}.json"


def load_places(arm: str) -> Places:
    """Return the places of an arm; none where none was saved.

    Raises:
        ValidationError: the file is not this user's alone, or holds no places.
    """
    path = place_file(arm)
    try:
        stored = mapping("places", json.loads(read_private(path, state_dir())))
        return {identifier("place", name): _degrees(name, joints) for name, joints in stored.items()}
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, StateFileError, ValueError, RecursionError) as exc:
        raise ValidationError(f"the saved places of this arm cannot be read: {exc} ({path.name})") from exc


def save_places(arm: str, places: Mapping[str, Mapping[str, float]]) -> None:
    """Write the places of an arm; they are on the disk when this returns.

    Raises:
        ValidationError: there are too many.
        OSError: they could not be written.
    """
    if len(places) > PLACES_MAX:
        raise ValidationError(f"place must be one of at most {PLACES_MAX}; savePlace replaces one of the same name.")
    path = place_file(arm)
    adopt(state_dir())
    make_private(path.parent)
    draft = path.with_suffix(f".{os.getpid()}.draft")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            json.dump({name: dict(joints) for name, joints in places.items()}, file)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def _degrees(place: str, joints: object) -> dict[str, float]:
    return {
        joint: number(f"{place}[{joint!r}]", value, low=-DEGREES_MAX, high=DEGREES_MAX)
        for joint, value in mapping(place, joints).items()
    }
