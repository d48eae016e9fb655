"""Quaternions w, x, y, z: the one sign they are told with, and their yaw."""

from __future__ import annotations

import math
from collections.abc import Sequence


def w_positive(quat: Sequence[float]) -> list[float]:
    """The one of the two quaternions of a rotation whose w is not negative."""
    return [-value for value in quat] if quat[0] < 0 else list(quat)


def yaw_of(quat: Sequence[float]) -> float:
    """Rotation about z, radians, of a quaternion that need not be normalised.

    The z-y-x Euler yaw, ``atan2(2(wz + xy), w² + x² - y² - z²)``.
    """
    w, x, y, z = quat
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
