"""Limits and units of joints, as a robot's ``getFeatures`` states them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Range = tuple[float, float]
"""Lower and upper limit of a joint, in the unit that the robot states."""

JOINTS_MAX = 64


def joint_limits(features: Mapping[str, Any]) -> dict[str, Range]:
    """Return the joint limits in an answer to getFeatures; a world's first robot."""
    chosen = _first(features)
    found: dict[str, Range] = {}
    for key in ("joints", "ranges"):
        joints = chosen.get(key)
        for name, limits in joints.items() if isinstance(joints, Mapping) else ():
            pair = [value for value in limits if _finite(value)] if isinstance(limits, list | tuple) else []
            if len(pair) == 2 and pair[0] < pair[1]:
                # A real robot names the range of an action, such as pan.pos, and the position of the joint, pan.
                found[str(name)] = found[str(name).removesuffix(".pos")] = (float(pair[0]), float(pair[1]))
    return found


def joint_units(features: Mapping[str, Any]) -> dict[str, str]:
    """Return the unit of each joint in an answer to getFeatures.

    Of a world these are the first robot's.
    """
    units = _first(features).get("joint_units")
    named = list(units.items())[:JOINTS_MAX] if isinstance(units, Mapping) else []
    found = {str(name): str(unit)[:40] for name, unit in named}
    # A real robot names the unit of an action, such as pan.pos, and the position of the joint, pan.
    return {**{name.removesuffix(".pos"): unit for name, unit in found.items()}, **found}


def _first(features: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the features of a robot, of a world those of its first one."""
    robots = features.get("robots")
    chosen = next(iter(robots.values())) if isinstance(robots, Mapping) and robots else features
    return chosen if isinstance(chosen, Mapping) else {}


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
