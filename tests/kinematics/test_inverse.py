"""Inverse kinematics of the built-in arms, over random reachable poses of a fixed seed."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.reach_targets import reachable

from strands_robots.kinematics.chain import built_in
from strands_robots.kinematics.planner import TipGoal, nearest, rolled, solve

ARMS = ("so100", "so101")


@pytest.mark.parametrize("arm", ARMS)
def test_reachable_poses_are_solved_within_a_millimetre_and_a_degree(arm: str) -> None:
    chain = built_in(arm)
    for pose in reachable(chain, 60):
        solution = solve(chain, TipGoal(pose.position, pose.approach), chain.rest)
        assert solution is not None
        found = chain.forward(solution.joints)
        assert np.linalg.norm(found.position - pose.position) <= 1e-3
        assert np.degrees(np.arccos(np.clip(found.approach @ pose.approach, -1, 1))) <= 1.0
        assert (solution.joints >= chain.lows).all()
        assert (solution.joints <= chain.highs).all()


def test_solution_that_is_not_accepted_is_passed_over() -> None:
    chain = built_in("so100")
    goal = TipGoal(np.array([0.25, 0.0, 0.1]))
    assert solve(chain, goal, chain.rest, accept=lambda joints: False) is None


def test_same_goal_has_the_same_solution() -> None:
    chain = built_in("so101")
    goal = TipGoal(np.array([0.1, -0.2, 0.1]))
    first, second = solve(chain, goal, chain.lows), solve(chain, goal, chain.lows)
    assert first is not None
    assert second is not None
    assert (first.joints == second.joints).all()


def test_nearest_joints_to_a_far_point_stretch_towards_it() -> None:
    chain = built_in("so100")
    found = nearest(chain, TipGoal(np.array([0.0, 0.8, 0.1])), chain.rest)
    tip = chain.forward(found.joints).position
    assert not found.reached
    assert abs(tip[0]) < 0.05
    assert tip[1] > 0.35


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("yaw", [0.0, 0.7, 1.5, 3.0])
def test_roll_turns_the_jaws_to_close_along_a_direction(arm: str, yaw: float) -> None:
    chain = built_in(arm)
    down = solve(chain, TipGoal(np.array([0.22, 0.05, 0.05]), np.array([0.0, 0.0, -1.0])), chain.rest)
    assert down is not None
    assert chain.gripper is not None
    closing = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    both = [(sign, rolled(chain, down.joints, sign * closing)) for sign in (1, -1)]
    # Its roll does not make a whole turn, so one of the two may be outside its limits.
    sign, turned = next((sign, joints) for sign, joints in both if joints is not None)
    assert turned is not None
    pose = chain.forward(turned)
    assert pose.rotation @ chain.gripper.closing @ (sign * closing) == pytest.approx(1.0, abs=1e-3)
    assert np.linalg.norm(pose.position - chain.forward(down.joints).position) < 1e-6


def test_roll_has_no_direction_along_the_approach() -> None:
    chain = built_in("so100")
    assert rolled(chain, chain.rest, chain.forward(chain.rest).approach) is None
