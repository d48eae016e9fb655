"""A motion plays its segments one setpoint a step, and waits until the arm stands still."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from strands_robots.kinematics.arm import Arm, ArmState
from strands_robots.kinematics.chain import built_in
from strands_robots.kinematics.motion import STILL_STEPS, Motion, Segment
from strands_robots.kinematics.moves import Start, go_to, move_joints, set_gripper
from strands_robots.utils import ValidationError

ARM = Arm.of(built_in("so100"))
HOME = {**dict(zip([each.observed for each in ARM.maps], ARM.chain.rest, strict=True)), "gripper": 0.3}


def start(speed: float = 1.0) -> Start:
    return Start(ARM, ARM.state(HOME), 50.0, speed)


def settling() -> tuple[Motion, list[float]]:
    """Return a motion that has played its setpoints, and its clock, a step of 20 ms further with each look."""
    times = [0.0]
    motion = Motion(ARM, "go", {}, [Segment("one", [{"gripper": 1.0}, {"gripper": 2.0}], settles=True)], 50.0)
    motion.clock = lambda: times[0]
    assert motion.act(HOME) == {"gripper": 1.0}
    assert motion.act(HOME) == {"gripper": 2.0}
    return motion, times


def looks(
    motion: Motion, times: list[float], observation: dict[str, float], count: int, step: float = 0.02
) -> list[Any]:
    answers = []
    for _ in range(count):
        answers.append(motion.act(observation))
        times[0] += step
    return answers


def test_setpoints_are_played_in_order_and_then_the_arm_settles() -> None:
    motion, times = settling()
    for shift in (0.1, 0.2, 0.3):
        assert looks(motion, times, HOME | {"gripper": 0.3 + shift}, 1) == [()]
    assert looks(motion, times, HOME | {"gripper": 0.6}, STILL_STEPS) == [()] * (STILL_STEPS - 1) + [None]
    assert motion.finished


def test_body_whose_time_stands_still_has_not_settled() -> None:
    motion, times = settling()
    assert looks(motion, times, HOME, 100, step=0.0) == [()] * 100
    assert looks(motion, times, HOME, STILL_STEPS + 1)[-1] is None


def test_arm_that_never_stands_still_is_waited_for_a_second() -> None:
    motion, times = settling()
    answers = [looks(motion, times, HOME | {"gripper": 0.1 * (i % 2)}, 1)[0] for i in range(52)]
    assert answers[:50] == [()] * 50
    assert None in answers[50:]


def test_motion_keeps_the_speed_of_every_joint_in_every_step() -> None:
    motion = move_joints(start(0.5), {"shoulder_pan": 90.0, "wrist_roll": -60.0})
    frames = [np.array([frame[each.commanded] for each in ARM.maps]) for frame in motion.segments[0].frames]
    steps = np.abs(np.diff([ARM.chain.rest, *frames], axis=0)) * 50.0
    assert (steps <= 0.5 * ARM.bounds.speed * (1 + 1e-9)).all()


def test_resting_arm_starts_where_it_was_told_to_be() -> None:
    state = ArmState(np.array([0.0, 1.0, 2.0]), None)
    told = state.at_setpoints(np.array([0.02, 1.5, np.nan]))
    assert told.joints == pytest.approx([0.02, 1.0, 2.0])


def test_held_object_keeps_the_jaws_from_their_command() -> None:
    assert ARM.holding(ArmState(ARM.chain.rest, 0.11), opening=0.0) is True
    assert ARM.holding(ArmState(ARM.chain.rest, 0.01), opening=0.0) is False
    assert ARM.holding(ArmState(ARM.chain.rest, None), opening=0.0) is None


def test_joint_that_cannot_be_read_is_named() -> None:
    with pytest.raises(ValidationError, match=r"the arm's wrist_roll could not be read"):
        ARM.state({key: value for key, value in HOME.items() if key != "wrist_roll"})


def test_motions_are_named_by_what_was_asked() -> None:
    assert go_to(start(), "home", {}).instruction == "goTo place home"
    turned = move_joints(start(), {"shoulder_pan": 45.0, "wrist_roll": -60.0})
    assert turned.instruction == "moveJoints shoulder_pan 45.0 wrist_roll -60.0"
    assert set_gripper(start(), 0.5).opening == 0.5
