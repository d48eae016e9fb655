"""Objects around an arm: those that are seen, and the one between its jaws."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from strands_robots.kinematics.chain import Floats, TipPose


@dataclass(frozen=True, slots=True)
class SeenObject:
    """An object: centre (m) and yaw (rad) in the base frame, and its extents (m).

    ``round`` objects have no faces that the jaws must follow; ``fixed`` ones cannot be picked up.
    """

    name: str
    position: Floats
    yaw: float
    size: Floats
    round: bool = False
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class Held:
    """An object between the jaws.

    Attributes:
        offset: of its centre from the tip, in the frame of the tip (m).
        below: of its bottom from its centre (m).
        width: between the jaws (m).
        approach_deg: at which it was grasped, so that it stands upright.
        radius: of the circle within its outline from above (m).
        half: its half extents (m); zeros where only the radius is known.
        turn: rotation of its axes in the frame of the tip, by columns.
        round: as of :class:`SeenObject`.
    """

    name: str
    offset: Floats
    below: float
    width: float
    approach_deg: float
    radius: float = 0.0
    half: Floats = field(default_factory=lambda: np.zeros(3))
    turn: Floats = field(default_factory=lambda: np.eye(3))
    round: bool = False

    def centre(self, pose: TipPose) -> Floats:
        """Return the place of its centre for a pose of the tip (m)."""
        centre: Floats = pose.position + pose.rotation @ self.offset
        return centre
