"""Contacts of an arm along a path: with itself, its table and objects."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from strands_robots.kinematics.chain import (
    BALL,
    BOX,
    CYLINDER,
    TABLE,
    Chain,
    Floats,
    ObstacleShape,
    held_body,
    place_obstacle,
    spare_body,
)
from strands_robots.kinematics.objects import Held, SeenObject

STEP_RAD = 0.02
"""Largest step of a joint between two checked poses (rad or m)."""

DEEPER_M = 1e-3
"""How much deeper than at its start a path may press two parts that touch already."""

Contacts = Mapping[tuple[str, str], float]
"""Penetration in metres, above 0, by the names of the two parts."""


class ContactCheck:
    """Finds contacts of one chain; for one thread.

    Args:
        chain: the arm and its table.
        gripper: position of the gripper's joint; None for that of the home pose.
    """

    def __init__(self, chain: Chain, gripper: float | None = None) -> None:
        self._chain = chain
        self._gripper = gripper
        self._data: Any = chain.data(chain.rest, gripper)
        self.objects = frozenset(chain.objects.values())
        """Names of the objects in the model."""

    def at(self, joints: Floats) -> dict[tuple[str, str], float]:
        """Return the contacts of one pose."""
        model, data = self._chain.model, self._data
        self._chain.put(data, joints, self._gripper)
        mujoco.mj_collision(model, data)
        found: dict[tuple[str, str], float] = {}
        for index in range(data.ncon):
            depth = -float(data.contact.dist[index])
            if depth > 0 and not (self._chain.floats and 0 in model.geom_bodyid[data.contact.geom[index]]):
                first, second = (self._part(int(geom)) for geom in data.contact.geom[index])
                pair = (second, first) if first == TABLE else (first, second)
                found[pair] = max(depth, found.get(pair, 0.0))
        return found

    def along(self, path: Floats, known: Contacts | None = None) -> str:
        """Return the first contact along ``path`` (n, joints); empty for none.

        Parts that touch in ``known``, by default at the path's start, may touch on, but not press deeper.
        """
        allowed = self.at(path[0]) if known is None else known
        for joints in dense(path):
            problem = new_contact(self.at(joints), allowed)
            if problem:
                return problem
        return ""

    def _part(self, geom: int) -> str:
        model = self._chain.model
        body = int(model.geom_bodyid[geom])
        if body in self._chain.objects:
            return self._chain.objects[body]
        return TABLE if body == 0 else str(model.body(body).name).replace("_", " ")


def new_contact(contacts: Contacts, allowed: Contacts) -> str:
    """Name the first contact that is not ``allowed``; empty for none."""
    for (first, second), depth in contacts.items():
        if depth > allowed.get((first, second), -DEEPER_M) + DEEPER_M:
            return f"the {first} touches the {second}"
    return ""


def dense(path: Floats) -> Floats:
    """Return ``path`` with points at most :data:`STEP_RAD` apart."""
    parts = [path[:1]]
    for before, after in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.abs(after - before).max() / STEP_RAD)))
        shares = np.arange(1, count + 1)[:, None] / count
        parts.append(before + shares * (after - before))
    return np.concatenate(parts)


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
        body = spare_body(model, index)
        objects[body] = each.name
        turned = np.array([np.cos(each.yaw / 2), 0.0, 0.0, np.sin(each.yaw / 2)])
        half = each.size / 2 + np.array([CLEARANCE_M, CLEARANCE_M, 0.0])
        kind = CYLINDER if each.round else BOX
        place_obstacle(model, body, ObstacleShape(kind, half, each.position, turned))
    if held is not None and held.radius > 0:
        body = held_body(model)
        objects[body] = held.name
        place_obstacle(model, body, _carried(chain, held))
    return chain.beside(objects, model)


def _carried(chain: Chain, held: Held) -> ObstacleShape:
    """Return the shape of the held object in the frame of the body that has the tip."""
    site, turn = chain.model.site_quat[chain.site], np.zeros(4)
    rotation, quaternion = np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(rotation, site)
    position = chain.model.site_pos[chain.site] + rotation.reshape(3, 3) @ held.offset
    if not held.half.any():
        return ObstacleShape(BALL, np.full(3, held.radius), position, np.array([1.0, 0.0, 0.0, 0.0]))
    mujoco.mju_mat2Quat(turn, np.ascontiguousarray(held.turn).ravel())
    mujoco.mju_mulQuat(quaternion, site, turn)
    return ObstacleShape(CYLINDER if held.round else BOX, held.half, position, quaternion)


def _is_table(chain: Chain, each: SeenObject) -> bool:
    return each.fixed and float(each.position[2] + each.size[2] / 2) <= chain.table_z + FLAT_M
