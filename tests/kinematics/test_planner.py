"""Paths that are checked first, and refusals that name the joint, the contact or the nearest point."""

from __future__ import annotations

import numpy as np
import pytest

from strands_robots.kinematics.chain import built_in
from strands_robots.kinematics.objects import ContactCheck
from strands_robots.kinematics.planner import Planner
from strands_robots.utils import ValidationError

ABOVE = np.array([0.22, 0.0, 0.1])


def planner(arm: str = "so100", start: np.ndarray | None = None) -> Planner:
    chain = built_in(arm)
    return Planner(chain, chain.rest if start is None else start, gripper=0.3)


def test_steepest_reachable_approach_is_taken() -> None:
    assert planner().reach(np.array([0.25, 0.0, 0.012])).approach_deg == 90.0
    # The SO-101's wrist does not bend far enough to point straight down there.
    assert planner("so101").reach(np.array([0.25, 0.1, 0.092])).approach_deg == 85.0


def test_asked_approach_is_taken_or_refused() -> None:
    found = planner().reach(np.array([0.25, 0.1, 0.05]), approach_deg=45.0)
    pose = planner().chain.forward(found.joints)
    assert pose.approach_deg == pytest.approx(45.0, abs=1.0)
    with pytest.raises(ValidationError, match="out of reach with an approach of 90 degrees; the nearest reachable"):
        planner().reach(np.array([0.2, 0.0, 0.15]), approach_deg=90.0)


def test_point_out_of_reach_is_refused_with_the_nearest_point() -> None:
    with pytest.raises(ValidationError, match=r"\(0\.600, 0\.000, 0\.100\) m is out of reach.*\(0\.48\d, .* mm away"):
        planner().reach(np.array([0.6, 0.0, 0.1]))


def test_point_in_the_table_is_refused_by_its_contact() -> None:
    with pytest.raises(ValidationError, match=r"cannot be at .*: there the gripper touches the table"):
        planner().reach(np.array([0.25, 0.0, -0.02]))


def test_joint_outside_its_limit_is_refused_with_the_range() -> None:
    with pytest.raises(ValidationError, match=r"elbow_flex must be from 0\.0 to 180\.0 degrees, not -5\.0"):
        planner().joints({"elbow_flex": np.radians(-5.0)})
    with pytest.raises(ValidationError, match="there is no knee"):
        planner().joints({"knee": 0.0})


def test_line_keeps_the_tip_on_it() -> None:
    plan = planner()
    begin = plan.path(plan.reach(ABOVE, approach_deg=60.0).joints)[-1][-1]
    down = planner(start=begin)
    path = down.line(np.array([0.22, 0.0, 0.02]))
    tips = np.array([down.chain.forward(joints).position for joints in path])
    assert np.abs(tips[:, :2] - ABOVE[:2]).max() < 1e-3
    assert (np.diff(tips[:, 2]) < 0).all()
    assert down.chain.forward(path[-1]).approach_deg == pytest.approx(60.0, abs=1.0)


def test_line_into_the_table_is_refused_by_its_contact() -> None:
    plan = planner()
    with pytest.raises(ValidationError, match="blocked: the gripper touches the table"):
        planner(start=plan.reach(ABOVE).joints).line(np.array([0.22, 0.0, -0.03]))


def test_path_through_the_table_is_led_over_it() -> None:
    low = planner().reach(np.array([0.16, 0.12, 0.012])).joints
    plan = planner(start=low)
    goal = plan.reach(np.array([0.36, -0.12, 0.012])).joints
    check = ContactCheck(plan.chain, 0.3)
    for leg in plan.path(goal):
        assert check.along(leg, {}) == ""
    assert (plan.path(goal)[-1][-1] == goal).all()


def test_self_contact_is_named_by_both_parts() -> None:
    plan = planner()
    folded = plan.joints({"shoulder_lift": -3.1, "elbow_flex": 3.1, "wrist_flex": 1.7})
    with pytest.raises(ValidationError, match="blocked: the shoulder touches the gripper"):
        plan.path(folded)


def test_arm_that_touches_already_may_leave() -> None:
    chain = built_in("so100")
    down = planner().reach(np.array([0.25, 0.0, 0.012])).joints.copy()
    # Pressed into the table by about two millimetres.
    down[1] += 0.05
    touching = ContactCheck(chain, 0.3).at(down)
    assert ("gripper", "table") in touching
    plan = Planner(chain, down, gripper=0.3)
    assert plan.path(plan.reach(ABOVE).joints)
