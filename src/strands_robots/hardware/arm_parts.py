"""Parts of an arm that a device has, told without its model.

Neither MuJoCo nor numpy is loaded: a robot says what it can do before its first motion. The model decides then; a
calibration that does not fit it is found with the first motion.
"""

from __future__ import annotations

import math
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from strands_robots.hardware.device_facts import calibration, joint_units, kind
from strands_robots.hardware.speed import units_per_radian
from strands_robots.hardware.stated_joints import stated_joints
from strands_robots.kinematics.arm_parts import ArmParts
from strands_robots.policies.base import Ranges

MODEL_OF = {"so100_follower": "so101", "so101_follower": "so101", "so_follower": "so101"}
"""The built-in model of each of LeRobot's arms."""

_BUILT_IN = ("so100", "so101")
_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
"""Joints of the built-in models."""

_JAWS = "gripper"


def model_name(device: Any, model: str | None) -> str:
    """Return the model that is stated, else that of the device's type; "" for none."""
    return model or MODEL_OF.get(kind(device), "")


def arm_parts(device: Any, bounds: Ranges, model: str | None) -> ArmParts:
    """Return what a device has of an arm.

    Args:
        device: the device.
        bounds: range of every action key.
        model: so100, so101 or the path of an MJCF file; by default that of the device's type.
    """
    name = model_name(device, model)
    if not name:
        movable = any(not each.refusal for each in stated_joints(device, bounds))
        return ArmParts(joints=movable and _installed("numpy"))
    if not (_installed("mujoco") and _installed("numpy")):
        return ArmParts()
    if name in _BUILT_IN:
        return _parts(_jaws(bounds, _JAWS)) if _fits(device, bounds) else ArmParts()
    if not Path(name).expanduser().is_file():
        return ArmParts()
    # LeRobot's grippers are told in percent; what the model calls its own is known once it is loaded.
    percent = [key for key, unit in joint_units(device).items() if unit == "percent"]
    return _parts(any(_jaws(bounds, key.removesuffix(".pos")) for key in (*percent, _JAWS)))


@cache
def _installed(package: str) -> bool:
    return find_spec(package) is not None


def _parts(jaws: bool) -> ArmParts:
    return ArmParts(joints=True, model=True, tip=True, jaws=jaws)


def _jaws(bounds: Ranges, name: str) -> bool:
    return any(math.isfinite(end - low) for low, end in (bounds[key] for key in (f"{name}.pos", name) if key in bounds))


def _fits(device: Any, bounds: Ranges) -> bool:
    """Return True where the built-in joints are there, with known zero and sign."""
    factors, calibrated = units_per_radian(device), calibration(device)
    keys = [next((key for key in (f"{name}.pos", name) if key in bounds), "") for name in _JOINTS]
    inverted = any(getattr(calibrated.get(name), "drive_mode", 0) for name in _JOINTS)
    return not inverted and all(factors.get(key) for key in keys)
