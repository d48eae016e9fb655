"""Head poses: metres and radians, and the 4x4 matrix that the daemon speaks.

A pose is taken in the head's own frame, where the identity is the upright rest. Angles are extrinsic x-y-z, that is
``R = Rz(yaw) Ry(pitch) Rx(roll)``: positive pitch looks down, positive yaw looks left (the daemon's REST convention).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from strands_robots.utils import ValidationError, shown

ORTHONORMAL_WITHIN = 0.01
"""How far a rotation read from the daemon may be from orthonormal; its own kinematics are exact to about 3e-4."""


@dataclass(frozen=True, slots=True)
class HeadPose:
    """``x``, ``y``, ``z`` in metres, ``roll``, ``pitch``, ``yaw`` in radians."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0

    def matrix(self) -> list[float]:
        """The homogeneous transform, row-major, sixteen numbers."""
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        cp, sp = math.cos(self.pitch), math.sin(self.pitch)
        cy, sy = math.cos(self.yaw), math.sin(self.yaw)
        return [
            *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, self.x),
            *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, self.y),
            *(-sp, cp * sr, cp * cr, self.z),
            *(0.0, 0.0, 0.0, 1.0),
        ]

    @classmethod
    def from_matrix(cls, flat: Sequence[float]) -> HeadPose:
        """The pose of a row-major transform. At pitch +-90 degrees roll is taken as zero.

        Raises:
            ValidationError: not sixteen finite numbers, or no rotation in them.
        """
        m = list(flat)
        if len(m) != 16 or not all(map(math.isfinite, m)):
            raise ValidationError(f"head pose must be 16 finite numbers, not {shown(flat)}.")
        rows = (m[0:3], m[4:7], m[8:11])
        off = max(abs(_dot(rows[i], rows[j]) - (i == j)) for i in range(3) for j in range(i, 3))
        if off > ORTHONORMAL_WITHIN:
            raise ValidationError(f"head pose must hold a rotation; its rows are {off:.3g} from orthonormal.")
        pitch = math.atan2(-m[8], math.hypot(m[0], m[4]))
        if math.hypot(m[0], m[4]) < 1e-9:
            roll, yaw = 0.0, math.atan2(-m[1], m[5])
        else:
            roll, yaw = math.atan2(m[9], m[10]), math.atan2(m[4], m[0])
        return cls(m[3], m[7], m[11], roll, pitch, yaw)

    def angle_to(self, other: HeadPose) -> float:
        """Radians of the one rotation that turns this head into ``other``."""
        a, b = self.matrix(), other.matrix()
        # The chord keeps small angles exact where the arc cosine of a trace near 3 loses half its digits:
        # |A - B| in the Frobenius norm is sqrt(8) sin(angle / 2).
        chord = math.sqrt(sum((a[i] - b[i]) ** 2 for i in _ROTATION))
        return 2 * math.asin(min(1.0, chord / math.sqrt(8)))

    def turn_to(self, other: HeadPose) -> float:
        """Radians of roll, pitch and yaw added up: never less than :meth:`angle_to`."""
        return abs(self.roll - other.roll) + abs(self.pitch - other.pitch) + abs(self.yaw - other.yaw)

    def distance_to(self, other: HeadPose) -> float:
        """Metres between the two head positions."""
        return math.dist((self.x, self.y, self.z), (other.x, other.y, other.z))

    def toward(self, other: HeadPose, share: float) -> HeadPose:
        """The pose ``share`` (0 to 1) of the way to ``other``, number by number; exactly ``other`` at 1."""
        if share >= 1:
            return other
        pairs = ((f.name, getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return HeadPose(**{name: start + (end - start) * share for name, start, end in pairs})


_ROTATION = (0, 1, 2, 4, 5, 6, 8, 9, 10)


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))
