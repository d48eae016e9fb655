"""Inverse kinematics by damped least squares with restarts.

The Jacobian is ``mj_jacSite``'s, and every step is clamped to the limits. Position and approach direction are asked
for; the roll about the approach is free and is set by :func:`rolled`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from strands_robots.kinematics.chain import Chain, Floats

STARTS = 20
"""Starts of one solve: the present joints, then points spread over the limits."""

POSITION_TOLERANCE_M = 1e-3
DIRECTION_TOLERANCE_RAD = np.radians(1.0)

_ITERATIONS = 60
_FINE_M, _FINE_RAD = 5e-5, np.radians(0.05)
_METRES_PER_RADIAN = 0.2
"""Weight of a direction error against a position error."""

Accept = Callable[[Floats], bool]
"""Says whether joints that reach the goal may be used, for example without contact."""


@dataclass(frozen=True, slots=True)
class TipGoal:
    """Position of the tip in the base frame (m), and its approach, or None for any."""

    position: Floats
    direction: Floats | None = None


@dataclass(frozen=True, slots=True)
class Solution:
    """Joints, and how far their tip is from the goal (m and rad)."""

    joints: Floats
    position_error: float
    direction_error: float

    @property
    def reached(self) -> bool:
        """True within 1 mm and 1 degree."""
        return self.position_error <= POSITION_TOLERANCE_M and self.direction_error <= DIRECTION_TOLERANCE_RAD


def solve(
    chain: Chain, goal: TipGoal, start: Floats, *, starts: int = STARTS, accept: Accept | None = None
) -> Solution | None:
    """Return joints whose tip is at ``goal``, near ``start`` if possible, else None."""
    solver = _Solver(chain, goal)
    for joints in _starts(chain, start, starts):
        found = solver.descend(joints)
        if found.reached and (accept is None or accept(found.joints)):
            return found
    return None


def nearest(chain: Chain, goal: TipGoal, start: Floats, *, starts: int = STARTS) -> Solution:
    """Return joints whose tip is nearest to ``goal``, its approach kept."""
    solver = _Solver(chain, goal)
    found = [solver.descend(joints) for joints in _starts(chain, start, starts)]
    return min(found, key=lambda each: (each.direction_error > DIRECTION_TOLERANCE_RAD, each.position_error))


def rolled(chain: Chain, joints: Floats, closing: Floats) -> Floats | None:
    """Turn the roll until the gripper closes along ``closing``.

    Args:
        chain: of an arm with a roll and a gripper.
        joints: which are not changed.
        closing: direction in the base frame; what of it lies along the approach does not count.

    Returns:
        The joints of the smaller turn within the limits; None where none is within.
    """
    if chain.roll is None or chain.gripper is None:
        return None
    pose = chain.forward(joints)
    now = pose.rotation @ chain.gripper.closing
    wanted = closing - pose.approach * float(closing @ pose.approach)
    if float(np.linalg.norm(wanted)) < 1e-6:
        return None
    turn = float(np.arctan2(float(pose.approach @ np.cross(now, wanted)), float(now @ wanted)))
    joint = chain.joints[chain.roll]
    # A positive roll may turn against the approach.
    bumped = joints.copy()
    bumped[chain.roll] += 0.1
    sign = float(np.sign(pose.approach @ np.cross(now, chain.forward(bumped).rotation @ chain.gripper.closing)))
    present = float(joints[chain.roll])
    turns = [present + sign * turn + k * 2 * np.pi for k in range(-2, 3)]
    within = [value for value in turns if joint.low <= value <= joint.high]
    if not within:
        return None
    turned = joints.copy()
    turned[chain.roll] = min(within, key=lambda value: abs(value - present))
    return turned


class _Solver:
    """Descends from a start to a goal on one scratch ``MjData``."""

    def __init__(self, chain: Chain, goal: TipGoal) -> None:
        self._chain = chain
        self._goal = goal
        self._data = chain.data(chain.rest)
        self._lows, self._highs = chain.lows, chain.highs
        self._moves = chain.movable
        self._places = np.array([joint.qpos for joint in chain.joints])
        self._dofs = np.array([chain.joints[i].dof for i in self._moves])
        self._jacp = np.zeros((3, chain.model.nv))
        self._jacr = np.zeros((3, chain.model.nv))
        self._axis_local = chain.axis

    def descend(self, start: Floats) -> Solution:
        """Return the best joints found from ``start``."""
        joints = np.clip(start, self._lows, self._highs)
        error, jacobian, at, turned = self._linearised(joints)
        cost, damping = float(error @ error), 1e-3
        moves, lows, highs = self._moves, self._lows[self._moves], self._highs[self._moves]
        for _ in range(_ITERATIONS):
            if at < _FINE_M and turned < _FINE_RAD:
                break
            gradient = jacobian.T @ error
            here = joints[moves]
            # A joint at its limit that would be pushed further takes no part in this step.
            held = ((here <= lows) & (gradient < 0)) | ((here >= highs) & (gradient > 0))
            jacobian[:, held] = 0.0
            gradient[held] = 0.0
            hessian = jacobian.T @ jacobian
            for _ in range(6):
                step = np.linalg.solve(hessian + damping * np.eye(len(moves)) * 0.01, gradient)
                trial = joints.copy()
                trial[moves] = np.clip(here + step, lows, highs)
                next_error, next_jacobian, next_at, next_turned = self._linearised(trial)
                next_cost = float(next_error @ next_error)
                if next_cost < cost:
                    break
                damping *= 8
            else:
                break
            gained = cost - next_cost
            joints, error, jacobian, at, turned = trial, next_error, next_jacobian, next_at, next_turned
            cost, damping = next_cost, max(damping / 4, 1e-7)
            if gained < 1e-4 * cost:
                break
        return Solution(joints, at, turned)

    def _linearised(self, joints: Floats) -> tuple[Floats, Floats, float, float]:
        """Return weighted error, Jacobian, and both errors (m, rad) at ``joints``."""
        data, chain, goal = self._data, self._chain, self._goal
        data.qpos[self._places] = joints
        mujoco.mj_kinematics(chain.model, data)
        mujoco.mj_comPos(chain.model, data)
        mujoco.mj_jacSite(chain.model, data, self._jacp, self._jacr, chain.site)
        offset = goal.position - data.site_xpos[chain.site]
        at = float(np.sqrt(offset @ offset))
        if goal.direction is None:
            return offset, self._jacp[:, self._dofs], at, 0.0
        axis = data.site_xmat[chain.site].reshape(3, 3) @ self._axis_local
        turn, angle = _turn(axis, goal.direction)
        jacobian = np.empty((6, len(self._dofs)))
        jacobian[:3] = self._jacp[:, self._dofs]
        spin = self._jacr[:, self._dofs]
        jacobian[3:] = _METRES_PER_RADIAN * (spin - np.outer(axis, axis @ spin))
        return np.concatenate([offset, _METRES_PER_RADIAN * turn]), jacobian, at, angle


def _turn(axis: Floats, towards: Floats) -> tuple[Floats, float]:
    """Return the rotation from one direction to another: vector and angle."""
    x, y, z = axis
    u, v, w = towards
    cross = np.array([y * w - z * v, z * u - x * w, x * v - y * u])
    sine = float(np.sqrt(cross @ cross))
    angle = float(np.arctan2(sine, x * u + y * v + z * w))
    return (cross * (angle / sine) if sine > 1e-9 else cross), angle


def _starts(chain: Chain, start: Floats, count: int) -> Iterator[Floats]:
    """Yield ``start``, then points of a fixed sequence spread over the limits."""
    yield start
    lows, spans = chain.lows, chain.highs - chain.lows
    draw: Any = np.random.default_rng(0)
    for _ in range(count - 1):
        yield lows + spans * draw.random(len(lows))
