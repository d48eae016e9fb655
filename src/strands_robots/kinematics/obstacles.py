"""Objects in a chain's model, where MuJoCo's contacts find them."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from strands_robots.kinematics import spares
from strands_robots.kinematics.chain import Chain
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
        held: what is between the jaws, which goes where the tip goes.
    """
    obstacles = [each for each in seen if not _is_table(chain, each) and (held is None or each.name != held.name)]
    # The base of a robot that moves about is not where its model has it.
    if chain.floats or not (obstacles or held):
        return chain
    model = chain.spares.model(len(obstacles))
    objects = {}
    for index, each in enumerate(obstacles):
        body = spares.body_of(model, index)
        objects[body] = each.name
        turned = np.array([np.cos(each.yaw / 2), 0.0, 0.0, np.sin(each.yaw / 2)])
        half = each.size / 2 + np.array([CLEARANCE_M, CLEARANCE_M, 0.0])
        kind = spares.CYLINDER if each.round else spares.BOX
        spares.put(model, body, spares.Shape(kind, half, each.position, turned))
    if held is not None and held.radius > 0:
        body = spares.held_body(model)
        objects[body] = held.name
        spares.put(model, body, _carried(chain, held))
    return chain.beside(objects, model)


def _carried(chain: Chain, held: Held) -> spares.Shape:
    """Return the shape of the held object in the frame of the body that has the tip."""
    site, turn = chain.model.site_quat[chain.site], np.zeros(4)
    rotation, quaternion = np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(rotation, site)
    position = chain.model.site_pos[chain.site] + rotation.reshape(3, 3) @ held.offset
    if not held.half.any():
        return spares.Shape(spares.BALL, np.full(3, held.radius), position, np.array([1.0, 0.0, 0.0, 0.0]))
    mujoco.mju_mat2Quat(turn, np.ascontiguousarray(held.turn).ravel())
    mujoco.mju_mulQuat(quaternion, site, turn)
    return spares.Shape(spares.CYLINDER if held.round else spares.BOX, held.half, position, quaternion)


def _is_table(chain: Chain, each: SeenObject) -> bool:
    return each.fixed and float(each.position[2] + each.size[2] / 2) <= chain.table_z + FLAT_M
