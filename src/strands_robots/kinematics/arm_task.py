"""The motions of an arm as tasks, and its saved places, one file an arm."""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from strands_robots.policies.rollout import Body, Rollout, RolloutObservers
from strands_robots.safety.gate import Permit
from strands_robots.state_files import StateFileError, adopt, make_private, read_private, state_dir
from strands_robots.utils import ValidationError, identifier, mapping, number

if TYPE_CHECKING:  # numpy and MuJoCo are loaded with the first motion
    from strands_robots.kinematics.motion import Motion
    from strands_robots.kinematics.objects import Sight

MOTION = "motion"
"""What a planned motion is called where a policy's name stands."""


@dataclass
class ArmTask:
    """One motion, running or ended.

    Attributes:
        outcome: how it ended, once it was asked for; it stays as it was then.
        sight: the objects before and after it; None where none can be seen.
        looked: set once the objects were looked at after it.
    """

    task_id: str
    rollout: Rollout
    motion: Motion
    outcome: dict[str, Any] | None = None
    sight: Sight | None = None
    looked: threading.Event = field(default_factory=threading.Event)

    @property
    def running(self) -> bool:
        """True until the motion has ended; a look at its end does not count."""
        return self.rollout.running

    @property
    def unseen(self) -> bool:
        """True while the end of a completed motion is looked at."""
        return self.rollout.state == "completed" and self.sight is not None and not self.looked.is_set()

    def join(self, seconds: float) -> None:
        """Wait for the end and the look at it."""
        until = time.monotonic() + seconds
        self.rollout.join(seconds)
        if self.unseen:
            self.looked.wait(max(0.0, until - time.monotonic()))


def motion_rollout(body: Body, motion: Motion, permit: Permit, hz: float, observers: RolloutObservers) -> Rollout:
    """Return the rollout that plays a motion; what it grips in the end it keeps."""
    return Rollout(
        body,
        motion,
        permit=permit,
        instruction=motion.instruction,
        policy_name=MOTION,
        duration=motion.duration,
        hz=hz,
        observers=observers,
        ends_at_rest=True,
    )


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
