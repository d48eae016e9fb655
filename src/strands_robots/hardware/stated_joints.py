"""Joints that a device states by keys, units and ranges, and what stays still."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from strands_robots.hardware.device_facts import joint_units, of_known_encoder
from strands_robots.hardware.speed import units_per_radian
from strands_robots.kinematics.stated_joint import StatedJoint
from strands_robots.policies.base import Action, Ranges, is_velocity

SUFFIX = ".pos"
"""End of LeRobot's keys of positions."""

_OF_POSITIONS = ("degrees", "radians", "metres", "normalized", "percent")
"""Units of positions; a key with another one, such as newtons, is none."""


def stated_joints(device: Any, bounds: Ranges, speeds: Mapping[str, float] | None = None) -> tuple[StatedJoint, ...]:
    """Return the joints of a device, in the order of its action keys.

    Args:
        device: its ``joint_units`` or its motors state the units.
        bounds: range of every action key, in the device's unit.
        speeds: greatest speed by action key, in its unit a second.
    """
    units, factors, known = joint_units(device), units_per_radian(device), of_known_encoder(device)
    # A normalized position is an angle only by the counts of the calibration, of which one turn has to be known.
    factors = {
        key: each for key, each in factors.items() if units[key] != "normalized" or key.removesuffix(SUFFIX) in known
    }
    return tuple(
        _stated(key, units.get(key, ""), factors.get(key, 0.0), bounds[key], (speeds or {}).get(key, math.inf))
        for key in _positions(bounds, units)
    )


def still_action(device: Any, bounds: Ranges, told: Mapping[str, float], observed: Mapping[str, float]) -> Action:
    """Return an action that leaves every joint where it was told to be, or is.

    Velocities are zero. A key that may be no position, such as a force, is left out.
    """
    known = {key: value for key, value in {**observed, **told}.items() if key in bounds}
    positions = {key: known[key] for key in _positions(bounds, joint_units(device)) if key in known}
    return {**{key: 0.0 for key in bounds if is_velocity(key)}, **positions}


def _positions(bounds: Ranges, units: Mapping[str, str]) -> list[str]:
    return [key for key in bounds if not is_velocity(key) and (key.endswith(SUFFIX) or units.get(key) in _OF_POSITIONS)]


def _stated(key: str, unit: str, factor: float, bounds: tuple[float, float], speed: float) -> StatedJoint:
    name, slides = key.removesuffix(SUFFIX), unit == "metres"
    if not (factor or slides):
        what = "degrees" if unit else "degrees or metres"
        return StatedJoint(
            name, key, refusal=f"it is told in {unit or 'an unknown unit'}, of which no {what} can be made"
        )
    if not all(math.isfinite(end) for end in bounds):
        return StatedJoint(name, key, not slides, refusal="its limits are not stated; give joint_ranges")
    scale = 1.0 if slides else factor * math.pi / 180
    low, high = sorted(end / scale for end in bounds)
    return StatedJoint(name, key, not slides, round(low, 9), round(high, 9), 1.0 if slides else factor, speed)
