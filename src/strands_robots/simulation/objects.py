"""Objects of a world as a robot's base sees them."""

from __future__ import annotations

from typing import Any

import numpy as np

from strands_robots.kinematics.chain import Floats
from strands_robots.kinematics.objects import SeenObject
from strands_robots.simulation.physics import Snapshot
from strands_robots.simulation.plan import ObjectPlan
from strands_robots.utils import yaw_of


def targets_of(snapshot: Snapshot, base: dict[str, Any]) -> list[SeenObject]:
    """Return the objects in the frame of ``base``, a ``RobotBody.base_pose``."""
    data = snapshot.data()
    cosine, sine = np.cos(base["theta"]), np.sin(base["theta"])
    into_base = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    origin = np.array([base["x"], base["y"], base["z"]])
    found = []
    for item in snapshot.stage.plan.objects:
        body = data.body(item.name)
        position = into_base @ (body.xpos - origin)
        yaw = yaw_of([float(v) for v in body.xquat]) - float(base["theta"])
        yaw = float((yaw + np.pi) % (2 * np.pi) - np.pi)
        found.append(SeenObject(item.name, position, yaw, _extents(item), item.shape != "box", item.fixed))
    return found


def _extents(item: ObjectPlan) -> Floats:
    """Return the extents of an upright object along its own axes (m)."""
    x, y, z = item.size
    if item.shape == "box":
        return 2 * np.array([x, y, z])
    half = {"sphere": x, "cylinder": y, "capsule": x + y}[item.shape]
    return 2 * np.array([x, x, half])
