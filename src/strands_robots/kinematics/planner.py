"""Joints for a pose of an arm's tip, and paths of the arm that are checked first.

The Jacobian is ``mj_jacSite``'s, and every step is clamped to the limits. Position and approach direction are asked
for; the roll about the approach is free and is set by :func:`rolled`.

Deterministic: the points come from a fixed sequence, and the number of tries is bounded. The caller bounds the time.

Every method raises :class:`~strands_robots.utils.ValidationError`, which names the joint, the contact or the nearest
reachable point. Positions are metres in the base frame, angles of the caller degrees, joints radians of the model.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from strands_robots.kinematics.chain import ArmJoint, Chain, Floats
from strands_robots.kinematics.objects import CLEARANCE_M, DEEPER_M, ContactCheck, new_contact
from strands_robots.safety.process import shorten_time_slices
from strands_robots.utils import ValidationError

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


def nearest(chain: Chain, goal: TipGoal, start: Floats) -> Solution:
    """Return joints whose tip is nearest to ``goal``, its approach kept."""
    solver = _Solver(chain, goal)
    found = [solver.descend(joints) for joints in _starts(chain, start, STARTS)]
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


TRIES_MAX = 2000
"""Most points towards which the trees grow."""

STEP = 0.2
"""Length of a branch by its largest joint (rad or m)."""

SHORTCUTS = 60

Clear = Callable[[Floats, Floats], bool]
"""True where the straight way between two poses is free of contact."""


class _Tree:
    """Poses, and the one from which each was reached."""

    def __init__(self, root: Floats) -> None:
        self.points = root[None, :].copy()
        self.parents = [-1]

    def grow(self, towards: Floats, clear: Clear) -> tuple[int, bool]:
        """Take one step towards a pose.

        Returns:
            The new point and True, or the nearest and False where a contact is between.
        """
        index = int(np.argmin(np.abs(self.points - towards).max(axis=1)))
        near = self.points[index]
        offset = towards - near
        length = float(np.abs(offset).max())
        if length < 1e-9:
            return index, True
        point = near + offset * min(1.0, STEP / length)
        if not clear(near, point):
            return index, False
        self.points = np.concatenate([self.points, point[None, :]])
        self.parents.append(index)
        return len(self.parents) - 1, True

    def way(self, index: int) -> list[Floats]:
        """Return the poses from the root to a point."""
        found = []
        while index >= 0:
            found.append(self.points[index])
            index = self.parents[index]
        return found[::-1]


def path_around(
    start: Floats, goal: Floats, limits: tuple[Floats, Floats], clear: Clear, going: Callable[[], bool]
) -> list[Floats] | None:
    """Return poses from ``start`` to ``goal`` with free straight ways between them.

    Args:
        start: joints (rad or m), free of contact.
        goal: joints, free of contact.
        limits: least and greatest value of each joint.
        clear: the check of a straight way.
        going: asked before each step; false ends the search.

    Returns:
        The poses, or None where no way was found within the bounds.
    """
    draw = np.random.default_rng(0)
    lows, highs = limits
    trees = [_Tree(start), _Tree(goal)]
    for turn in range(TRIES_MAX):
        if not going():
            return None
        grown, other = trees[turn % 2], trees[(turn + 1) % 2]
        index, took = grown.grow(lows + (highs - lows) * draw.random(len(lows)), clear)
        if not took:
            continue
        target, meets = grown.points[index], False
        while True:
            reached, took = other.grow(target, clear)
            meets = took and bool(np.abs(other.points[reached] - target).max() < 1e-9)
            if meets or not took or not going():
                break
        if meets:
            first, second = grown.way(index), other.way(reached)
            way = first + second[-2::-1]
            return _shortened(way if turn % 2 == 0 else way[::-1], clear, draw, going)
    return None


def _shortened(way: list[Floats], clear: Clear, draw: np.random.Generator, going: Callable[[], bool]) -> list[Floats]:
    """Leave out poses that a free straight way passes by."""
    for _ in range(SHORTCUTS):
        if len(way) < 3 or not going():
            break
        first, last = sorted(int(each) for each in draw.choice(len(way), 2, replace=False))
        if last - first > 1 and clear(way[first], way[last]):
            del way[first + 1 : last]
    index = 0
    while index + 2 < len(way) and going():
        if clear(way[index], way[index + 2]):
            del way[index + 1]
        else:
            index += 1
    return way


APPROACH_STEP_DEG = 5.0
APPROACH_LOWEST_DEG = -45.0
"""Approaches are tried from straight down in these steps to this one, which points up."""

_LINE_STEP_M = 0.005
_LINE_JUMP_RAD = 0.35
"""Largest turn of a joint within one step of a line; a larger one is another posture of the arm."""

_RETREAT_M = (0.06, 0.12)
"""Heights above start and goal by which a path that would touch something is led."""


@dataclass(frozen=True, slots=True)
class Reached:
    """Joints at a point, and their approach in degrees below the horizontal."""

    joints: Floats
    approach_deg: float


class Planner:
    """Plans from one state of the arm; for one thread.

    Args:
        chain: the arm.
        start: its joint positions (rad).
        gripper: position of its gripper's joint; None for that of the home pose.
        going: false once the motion is not wanted any more, which ends a search.
    """

    def __init__(
        self, chain: Chain, start: Floats, gripper: float | None = None, going: Callable[[], bool] = lambda: True
    ) -> None:
        self.chain = chain
        self._going = going
        self.start = np.clip(start, chain.lows, chain.highs)
        self._check = ContactCheck(chain, gripper)
        # Objects are larger by the clearance: one that is only within it may be neared, but not touched.
        self._touching = {
            pair: min(depth, CLEARANCE_M - DEEPER_M)
            if self._check.objects & set(pair) and depth <= CLEARANCE_M
            else depth
            for pair, depth in self._check.at(self.start).items()
        }

    def joints(self, targets: Mapping[str, float]) -> Floats:
        """Return the present joints with some replaced, by name (rad).

        Raises:
            ValidationError: a joint that the arm has not, or a position outside its range.
        """
        by_name = {joint.name: index for index, joint in enumerate(self.chain.joints)}
        wanted = self.start.copy()
        for name, value in targets.items():
            if name not in by_name:
                raise ValidationError(f"joints must be of {', '.join(by_name)}; there is no {name}.")
            joint = self.chain.joints[by_name[name]]
            if joint.refusal:
                raise ValidationError(f"{name} cannot be moved to a position: {joint.refusal}.")
            if not joint.low <= value <= joint.high:
                raise ValidationError(f"{name} must be {_range(joint)}, not {_shown(joint, value)}.")
            wanted[by_name[name]] = value
        return wanted

    def reach(self, position: Floats, approach_deg: float | None = None) -> Reached:
        """Return joints whose tip is at ``position``.

        Args:
            position: metres in the base frame.
            approach_deg: degrees below the horizontal; None for the steepest reachable.
        """
        self.chain.require_arm()
        start = self.start
        if approach_deg is not None:
            direction = self.direction(position, approach_deg)
            found = solve(self.chain, TipGoal(position, direction), start, accept=self.free)
            if found is None:
                raise self._unreachable(TipGoal(position, direction), start, approach_deg)
            return Reached(found.joints, approach_deg)
        anyhow = solve(self.chain, TipGoal(position), start, accept=self.free)
        if anyhow is None:
            raise self._unreachable(TipGoal(position), start, None)
        for degrees in np.arange(90.0, APPROACH_LOWEST_DEG - 1, -APPROACH_STEP_DEG):
            direction = self.direction(position, float(degrees))
            for from_joints in (start, anyhow.joints):
                found = solve(self.chain, TipGoal(position, direction), from_joints, starts=4, accept=self.free)
                if found is not None:
                    return Reached(found.joints, float(degrees))
        return Reached(anyhow.joints, self.chain.forward(anyhow.joints).approach_deg)

    def free(self, joints: Floats) -> bool:
        """True for joints that bring no new contact."""
        return not new_contact(self._check.at(joints), self._touching)

    def meets(self, joints: Floats, *, objects: bool) -> bool:
        """True for joints that bring a new contact with an object, or of the arm alone."""
        known, contacts = self._check.objects, self._check.at(joints)
        chosen = {pair: depth for pair, depth in contacts.items() if bool(known & set(pair)) is objects}
        return bool(new_contact(chosen, self._touching))

    def direction(self, position: Floats, degrees: float) -> Floats:
        """Return the approach away from the shoulder, ``degrees`` below level."""
        away = position - self.chain.shoulder
        azimuth, below = np.arctan2(away[1], away[0]), np.radians(degrees)
        return np.array([np.cos(below) * np.cos(azimuth), np.cos(below) * np.sin(azimuth), -np.sin(below)])

    def find(self, position: Floats, approach_deg: float) -> Reached | None:
        """Return joints at a point with this approach, None where there are none."""
        goal = TipGoal(position, self.direction(position, approach_deg))
        found = solve(self.chain, goal, self.start, starts=6, accept=self.free)
        return None if found is None else Reached(found.joints, approach_deg)

    def path(self, goal: Floats) -> list[Floats]:
        """Return joint paths to ``goal``, one after another, without contact.

        One path where that is free, else up, across and down again, else around by a search.
        """
        begin = self.start
        direct = np.array([begin, goal])
        problem = self._check.along(direct, self._touching)
        if not problem:
            return [direct]
        for height in _RETREAT_M:
            stops = [begin, self._above(begin, height), self._above(goal, height), goal]
            known = [stop for stop in stops if stop is not None]
            legs = [np.array(pair) for pair in itertools.pairwise(known)]
            if len(legs) > 1 and not any(self._check.along(leg, self._touching) for leg in legs):
                return legs
        around = self._around(begin, goal)
        if around is None:
            late = "" if self._going() else "; the search around it was over its time"
            raise ValidationError(f"the way there is blocked: {problem}{late}.")
        return around

    def _around(self, begin: Floats, goal: Floats) -> list[Floats] | None:
        """Return legs that a search finds around contacts, None without any."""
        lows, highs = self.chain.lows.copy(), self.chain.highs.copy()
        for index, joint in enumerate(self.chain.joints):
            if joint.refusal:
                lows[index] = highs[index] = begin[index]
        if not (self.free(begin) and self.free(goal)):
            return None
        restore_time_slices = shorten_time_slices()
        try:
            poses = path_around(begin, goal, (lows, highs), self._clear, self._going)
        finally:
            restore_time_slices()
        return None if poses is None else [np.array(pair) for pair in itertools.pairwise(poses)]

    def _clear(self, first: Floats, last: Floats) -> bool:
        return not self._check.along(np.array([first, last]), self._touching)

    def line(self, goal: Floats, start: Floats | None = None, direction: Floats | None = None) -> Floats:
        """Return a joint path (n, joints) with the tip on a line to ``goal`` (m).

        Args:
            goal: position in the base frame.
            start: joints to begin with; the present ones by default.
            direction: approach along the way; by default as steep as at the start, where that can be kept.
        """
        self.chain.require_arm()
        joints = self.start if start is None else start
        pose = self.chain.forward(joints)
        offset = goal - pose.position
        count = max(1, int(np.ceil(float(np.linalg.norm(offset)) / _LINE_STEP_M)))
        path = [joints]
        for index in range(1, count + 1):
            point = pose.position + offset * (index / count)
            joints = self._next(point, joints, pose.approach_deg, direction)
            path.append(joints)
        points = np.array(path)
        problem = self._check.along(points, self._touching)
        if problem:
            raise ValidationError(f"the line there is blocked: {problem}.")
        return points

    def _next(self, point: Floats, joints: Floats, approach_deg: float, direction: Floats | None) -> Floats:
        wanted = self.direction(point, approach_deg) if direction is None else direction
        goals = [TipGoal(point, wanted)] if direction is not None else [TipGoal(point, wanted), TipGoal(point)]
        for goal in goals:
            found = solve(self.chain, goal, joints, starts=1)
            if found is not None and float(np.abs(found.joints - joints).max()) <= _LINE_JUMP_RAD:
                return found.joints
        raise self._unreachable(goals[-1], joints, None)

    def _above(self, joints: Floats, height: float) -> Floats | None:
        """Return joints with the tip ``height`` metres higher, None where that cannot be."""
        point = self.chain.forward(joints).position + np.array([0.0, 0.0, height])
        found = solve(self.chain, TipGoal(point), joints, starts=4, accept=self.free)
        return None if found is None else found.joints

    def _unreachable(self, goal: TipGoal, start: Floats, approach_deg: float | None) -> ValidationError:
        best = None
        if self._check.objects:
            best = solve(self.chain, goal, start, accept=lambda joints: not self.meets(joints, objects=False))
        best = nearest(self.chain, goal, start) if best is None else best
        wanted = f"({', '.join(f'{v:.3f}' for v in goal.position)}) m"
        how = "" if approach_deg is None else f" with an approach of {approach_deg:g} degrees"
        if best.reached:
            contact = new_contact(self._check.at(best.joints), self._touching)
            if contact:
                return ValidationError(f"the tip cannot be at {wanted}{how}: there {contact}.")
        at = self.chain.forward(best.joints).position
        near = f"({', '.join(f'{v:.3f}' for v in at)}) m, {best.position_error * 1000:.0f} mm away"
        return ValidationError(f"{wanted} is out of reach{how}; the nearest reachable point is {near}.")


def _range(joint: ArmJoint) -> str:
    if joint.turns:
        return f"from {np.degrees(joint.low):.1f} to {np.degrees(joint.high):.1f} degrees"
    return f"from {joint.low:.3f} to {joint.high:.3f} m"


def _shown(joint: ArmJoint, value: float) -> str:
    return f"{np.degrees(value):.1f}" if joint.turns else f"{value:.3f}"
