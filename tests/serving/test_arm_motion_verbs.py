"""Domains of the arm's verbs, and robots that have no arm."""

from __future__ import annotations

import math
from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot

from strands_robots.contract import adapt
from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS, WORLD_MOTION_VERBS
from strands_robots.serving.verbs import Kind
from strands_robots.utils import ValidationError


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "0.1", 3.01])
def test_coordinate_outside_its_domain_is_refused_by_name(value: Any) -> None:
    with pytest.raises(ValidationError, match="z must be a finite number from -3 to 3"):
        ARM_MOTION_VERBS["moveTo"].checked({"x": 0.2, "y": 0.0, "z": value})


@pytest.mark.parametrize("joints", [{}, [1.0], {"elbow_flex": math.nan}, {"elbow_flex": False}, {"elbow_flex": 1e9}])
def test_joints_must_be_degrees_by_name(joints: Any) -> None:
    with pytest.raises(ValidationError, match="joints"):
        ARM_MOTION_VERBS["moveJoints"].checked({"joints": joints})


def test_approach_may_be_left_out_and_the_other_options_have_defaults() -> None:
    checked = ARM_MOTION_VERBS["moveTo"].checked({"x": 0, "y": 0, "z": 0.1})
    assert checked == {"x": 0.0, "y": 0.0, "z": 0.1, "approach": None, "speed": 0.5, "wait": True, "lease_id": ""}


def test_a_world_names_the_robot_besides() -> None:
    for name, verb in WORLD_MOTION_VERBS.items():
        assert list(verb.by_name) == [*ARM_MOTION_VERBS[name].by_name, "robot_name"]


def test_reads_need_no_leave_to_move() -> None:
    reads = {name for name, verb in ARM_MOTION_VERBS.items() if verb.kind is Kind.READ}
    assert reads == {"getPose", "getObjects", "wait"}


def test_robot_without_an_arm_says_so() -> None:
    verb = ARM_MOTION_VERBS["getPose"]
    assert verb.run is not None
    answer: Any = verb.run(adapt(ToyRobot()), {})
    assert answer["reason"] == "This robot has no arm whose motions can be planned here."
