"""Objects in a chain's model, where MuJoCo's contacts find them."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from strands_robots.kinematics.chain import OBJECT, Chain
from strands_robots.kinematics.objects import Held, SeenObject

CLEARANCE_M = 0.003
"""Distance that a path keeps from an object's sides."""

FLAT_M = 0.002
"""Height above the table up to which a fixed object is a table itself."""


def beside(chain: Chain, seen: Sequence[SeenObject], held: Held | None = None) -> Chain:
    """Return a chain whose model has objects as obstacles.

    Args:
        chain: it is not changed.
        seen: objects in the base frame. One of them that is held is no obstacle.
        held: what is between the jaws; a ball within it goes where the tip goes.
    """
    obstacles = [each for each in seen if not _is_table(chain, each) and (held is None or each.name != held.name)]
    # The base of a robot that moves about is not where its model has it.
    if chain.floats or not (obstacles or held):
        return chain
    spec = chain.spec()
    for each in obstacles:
        turned = [float(np.cos(each.yaw / 2)), 0.0, 0.0, float(np.sin(each.yaw / 2))]
        body = spec.worldbody.add_body(name=OBJECT + each.name, pos=list(each.position), quat=turned)
        x, y, z = (float(value) / 2 for value in each.size)
        if each.round:
            kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [max(x, y) + CLEARANCE_M, z, 0.0]
        else:
            kind, size = mujoco.mjtGeom.mjGEOM_BOX, [x + CLEARANCE_M, y + CLEARANCE_M, z]
        body.add_geom(type=kind, size=size, contype=_ALL, conaffinity=_ALL)
    if held is not None and held.radius > 0:
        chain.add_at_tip(spec, held.offset, held.radius)
    return chain.recompiled(spec)


_ALL = 0x7FFFFFFF
"""Contact bits that meet every geom which meets any other."""


def _is_table(chain: Chain, each: SeenObject) -> bool:
    return each.fixed and float(each.position[2] + each.size[2] / 2) <= chain.table_z + FLAT_M
