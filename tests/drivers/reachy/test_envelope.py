"""How far, and how fast."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from strands_robots.drivers.reachy import gestures
from strands_robots.drivers.reachy.envelope import (
    ACTION_KEYS,
    FRAME_STEP,
    RAMP_STEP,
    Target,
    bounded,
    check,
    from_action,
)
from strands_robots.drivers.reachy.pose import HeadPose
from strands_robots.utils import ValidationError

DEGREES = math.degrees(1)
tilt = st.floats(-math.radians(30), math.radians(30))
heads = st.builds(HeadPose, roll=tilt, pitch=tilt, yaw=st.floats(-math.pi, math.pi), z=st.floats(-0.03, 0.015))
antennas = st.tuples(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
targets = st.builds(Target, head=heads, body_yaw=st.floats(-2.79, 2.79), antennas=antennas)


@given(st.floats(-40, 40))
def test_a_value_inside_comes_back_in_radians(degrees: float) -> None:
    assert bounded("head_pitch", degrees, unit="degrees", scale=DEGREES) == pytest.approx(math.radians(degrees))


@given(
    st.one_of(
        st.floats(min_value=40.001),
        st.floats(max_value=-40.001),
        st.just(math.nan),
        st.booleans(),
        st.text(),
        st.none(),
        st.lists(st.floats()),
        st.integers(min_value=10**400, max_value=10**401),
    )
)
def test_anything_else_is_refused_with_name_unit_and_domain(value: Any) -> None:
    with pytest.raises(ValidationError, match=r"pitch \(degrees\) must be a finite number from -40 to 40, not "):
        bounded("head_pitch", value, unit="degrees", scale=DEGREES, name="pitch")


def test_pitch_and_roll_are_bounded_together_too() -> None:
    check(Target(HeadPose(pitch=math.radians(30), roll=math.radians(-30))), automatic_body_yaw=True)
    with pytest.raises(ValidationError, match="at most 60 degrees, not 61"):
        check(Target(HeadPose(pitch=math.radians(40), roll=math.radians(21))), automatic_body_yaw=True)


def test_head_and_body_part_by_65_degrees_at_most_only_while_the_body_does_not_turn_along() -> None:
    apart = Target(HeadPose(yaw=math.radians(70)), 0.0)
    assert check(apart, automatic_body_yaw=True) is apart
    with pytest.raises(ValidationError, match="at most 65 degrees apart"):
        check(apart, automatic_body_yaw=False)
    with pytest.raises(ValidationError, match="at most 65 degrees apart"):
        check(Target(HeadPose(yaw=math.radians(70))), automatic_body_yaw=False, body_yaw=0.0)


@given(targets, targets)
def test_a_ramp_ends_at_its_target_and_no_frame_of_it_is_a_jump(start: Target, end: Target) -> None:
    frames = list(gestures.ramp(start, end))
    assert frames[-1] is end
    before = start
    for frame in frames:
        assert frame.step_from(before) * FRAME_STEP <= RAMP_STEP * 1.01
        before = frame


@given(targets, st.sampled_from([gestures.nod, gestures.shake, gestures.happy]))
def test_a_gesture_stays_inside_the_envelope_and_never_jumps(start: Target, gesture: Any) -> None:
    before = start
    for frame in gesture(start):
        check(frame, automatic_body_yaw=True)
        for key, value in frame.action().items():
            bounded(key, value)
        assert frame.step_from(before) <= 1.0
        before = frame.over(before)


def test_an_action_keeps_what_it_does_not_name() -> None:
    start = Target(HeadPose(pitch=0.1, z=0.01), 0.2, (0.3, -0.3))
    target = from_action({"head_yaw": 0.5, "antenna_left": 1.0}, start)
    assert target == Target(HeadPose(pitch=0.1, z=0.01, yaw=0.5), None, (0.3, 1.0))


@given(targets)
def test_an_action_and_its_target_say_the_same(target: Target) -> None:
    assume(target.head is not None and abs(target.head.pitch) + abs(target.head.roll) < 1)
    assert from_action(dict(target.action()), Target()) == target
    assert set(target.action()) == set(ACTION_KEYS)


@pytest.mark.parametrize(
    ("action", "says"),
    [
        ({}, "keys of"),
        ([], "keys of"),
        ({"head_tilt": 1}, "no key 'head_tilt'"),
        ({"head_pitch": math.inf}, "head_pitch must be"),
        ({"antenna_left": None}, "antenna_left must be"),
    ],
)
def test_a_bad_action_is_refused(action: Any, says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        from_action(action, Target())
