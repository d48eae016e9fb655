"""Speed limit of a real robot's joints, in the units of its actions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from strands_robots.hardware.device_facts import half_ranges, joint_units
from strands_robots.policies.base import JOINT_SPEED_RAD_S


def default_speeds(device: Any) -> dict[str, float]:
    """Return 2 rad/s in the unit of each joint whose unit is an angle.

    A gripper that is told in percent, a base's velocity and a joint without a known unit have no bound of their own.
    """
    return {key: JOINT_SPEED_RAD_S * per_radian for key, per_radian in units_per_radian(device).items()}


def units_per_radian(device: Any) -> dict[str, float]:
    """Return the device's units in one radian, by action key, where that is known."""
    halves = half_ranges(device)
    factors = {
        key: _per_radian(unit, halves.get(key.removesuffix(".pos"))) for key, unit in joint_units(device).items()
    }
    return {key: per_radian for key, per_radian in factors.items() if per_radian}


def _per_radian(unit: str, half_range: float | None) -> float:
    """Return units per radian, 0 where that is not known."""
    known: Mapping[str, float] = {
        "radians": 1.0,
        "degrees": 180 / math.pi,
        "normalized": 100 / half_range if half_range else 0.0,
    }
    return known.get(unit, 0.0)
