"""The task of one planned motion: its rollout, its outcome, the look at its end."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from strands_robots.policies.rollout import Body, Rollout, RolloutObservers
from strands_robots.safety.gate import Permit

if TYPE_CHECKING:  # numpy and MuJoCo are loaded with the first motion
    from strands_robots.kinematics.motion import Motion
    from strands_robots.kinematics.sight import Sight

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
