"""Real arm as a chain: joints mapped to a model's and checked.

LeRobot's calibration of an SO-100 or SO-101 puts zero at the middle of each joint's range, and so does the model of
the SO-101; the two arms' joint axes lie within 1 mm of one another, and the servos turn the same way. So its model is
that of both arms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco

from strands_robots.hardware.device_facts import calibration, half_ranges, joint_units, kind, model_name
from strands_robots.kinematics.arm import Arm, JawMap, JointMap
from strands_robots.kinematics.chain import MODELS, ArmJoint, Chain, built_in
from strands_robots.kinematics.model_file import load_model
from strands_robots.policies.base import Ranges
from strands_robots.utils import ValidationError, shown

SPAN_TOLERANCE_RAD = 0.4
"""Greatest difference between a joint's calibrated half range and the model's; more means another zero."""

FULL_TURN_RAD = math.pi * 0.99
"""Half range of a joint that was calibrated without ends; it tells nothing about the zero."""


def arm_of(device: Any, bounds: Ranges, model: str | None = None, speeds: Mapping[str, float] | None = None) -> Arm:
    """Return the arm of a LeRobot device.

    Args:
        device: the device.
        bounds: range of every action key, in the device's unit.
        model: so100, so101 or the path of an MJCF file; by default that of the device's type.
        speeds: the robot's speed limit by action key.

    Raises:
        ValidationError: no model is known, or its joints do not fit the device; the message names the joint.
    """
    chain = chain_of(device, model)
    units = joint_units(device)
    maps = tuple(_mapped(device, joint, bounds, units, chain.label) for joint in chain.joints)
    ranges = {
        joint.name: tuple(sorted(each.radians(end) for end in bounds[each.commanded]))
        for joint, each in zip(chain.joints, maps, strict=True)
        if all(math.isfinite(end) for end in bounds[each.commanded])
    }
    narrowed = chain.limited({name: (low, high) for name, (low, high) in ranges.items()})
    return Arm(narrowed, maps, _jaw(chain, bounds), speeds or {})


def chain_of(device: Any, model: str | None) -> Chain:
    """Return the chain of a device. Raises :class:`ValidationError` without a model."""
    name = model_name(device, model)
    if not name:
        raise ValidationError(f"no model of {kind(device)} is known; give model, an MJCF file of the arm.")
    if (MODELS / f"{name}.xml").is_file():
        return built_in(name)
    path = Path(name).expanduser()
    if not path.is_file():
        raise ValidationError(f"model must be so100, so101 or an MJCF file; there is no {shown(name)}.")
    try:
        return Chain(load_model(path, name), path.stem)
    except mujoco.FatalError as exc:
        raise ValidationError(f"model {shown(name)} cannot be loaded: {' '.join(str(exc).split())[:300]}") from exc


def _mapped(device: Any, joint: ArmJoint, bounds: Ranges, units: Mapping[str, str], label: str) -> JointMap:
    key = next((key for key in (f"{joint.name}.pos", joint.name) if key in bounds), None)
    if key is None:
        raise ValidationError(f"the model {label} does not fit: {kind(device)} has no joint {joint.name}.")
    unit = units.get(key, "")
    entry = calibration(device).get(joint.name)
    half = half_ranges(device).get(joint.name)
    if entry is not None and half is not None:
        if entry.drive_mode:
            raise ValidationError(f"{joint.name} is calibrated with drive_mode 1, so its sign is not known.")
        wanted = (joint.high - joint.low) / 2
        if half < FULL_TURN_RAD and abs(half - wanted) > SPAN_TOLERANCE_RAD:
            raise ValidationError(
                f"the model {label} does not fit: {joint.name} is calibrated for {math.degrees(2 * half):.0f} degrees "
                f"and turns {math.degrees(2 * wanted):.0f} in the model."
            )
    if unit == "radians":
        return JointMap(key, key)
    if unit == "degrees":
        return JointMap(key, key, 180 / math.pi)
    if unit == "normalized" and half is not None:
        return JointMap(key, key, 100 / half)
    raise ValidationError(f"{joint.name} is told in {unit or 'an unknown unit'}, so degrees cannot be made of it.")


def _jaw(chain: Chain, bounds: Ranges) -> JawMap | None:
    gripper = chain.gripper
    if gripper is None:
        return None
    name = gripper.joint.name
    key = next((key for key in (f"{name}.pos", name) if key in bounds), None)
    if key is None or not all(math.isfinite(end) for end in bounds[key]):
        return None
    return JawMap(key, key, bounds[key], bounds[key])
