"""Arms from their MJCF: tip poses, joints for a pose, contacts, checked paths.

Here are the parts of an arm, the joints that it states, and its saved places: what a robot tells without numpy.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from strands_robots.state_files import StateFileError, adopt, make_private, read_private, state_dir
from strands_robots.utils import ValidationError, identifier, mapping, number


@dataclass(frozen=True, slots=True)
class ArmParts:
    """Parts of an arm that a body has.

    Attributes:
        joints: some joint is moved to positions.
        model: where the tip is can be computed.
        tip: the tip can be moved to a point.
        jaws: a gripper opens and closes.
    """

    joints: bool = False
    model: bool = False
    tip: bool = False
    jaws: bool = False

    def verbs(self, *, sees: bool) -> frozenset[str]:
        """Return the names of the verbs that these parts carry out.

        Args:
            sees: objects are known, or a detector sees them.
        """
        places = self.joints and self.model
        needs = {
            "moveJoints": self.joints,
            "getPose": self.model,
            "goTo": places,
            "savePlace": places,
            "moveTo": self.tip,
            "moveBy": self.tip,
            "setGripper": self.jaws,
            "pick": self.tip and self.jaws,
            "place": self.tip and self.jaws,
            "getObjects": self.model and sees,
        }
        verbs = {name for name, has in needs.items() if has}
        return frozenset(verbs | {"wait"} if verbs - {"getPose", "getObjects"} else verbs)


_SLACK = 1e-6
"""Greatest distance beyond a limit that is a rounding, in degrees or metres."""


@dataclass(frozen=True, slots=True)
class StatedJoint:
    """One joint of a robot without a model.

    Attributes:
        name: as callers name it.
        key: in observations and actions of the robot.
        turns: it turns, and is told in degrees; else it slides, and is told in metres.
        low: lowest position, in degrees or metres.
        high: highest position.
        factor: the robot's units in one radian or metre.
        speed: greatest speed in the robot's units a second; infinite where none is stated.
        refusal: why it cannot be moved to a position; empty where it can.
    """

    name: str
    key: str
    turns: bool = True
    low: float = -math.inf
    high: float = math.inf
    factor: float = 1.0
    speed: float = math.inf
    refusal: str = ""

    def position(self, value: float) -> float:
        """Return a position of a caller in radians, of a slide in metres.

        Raises:
            ValidationError: the joint cannot be moved, or not there.
        """
        if self.refusal:
            raise ValidationError(f"{self.name} cannot be moved to a position: {self.refusal}.")
        if not self.low - _SLACK <= value <= self.high + _SLACK:
            unit = "degrees" if self.turns else "m"
            raise ValidationError(f"{self.name} must be from {self.low:g} to {self.high:g} {unit}, not {value:g}.")
        return math.radians(value) if self.turns else value


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
