"""Contacts of an arm with itself and its table along a path."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from strands_robots.kinematics.chain import TABLE, Chain, Floats

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
