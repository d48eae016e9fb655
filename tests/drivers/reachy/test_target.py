"""Head poses, the reach of targets, and the frames of ramps and gestures."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from strands_robots.drivers.reachy.target import (
    ACTION_KEYS,
    FRAME_STEP,
    GESTURES,
    RAMP_STEP,
    Gesture,
    HeadPose,
    Target,
    bounded,
    check,
    from_action,
    ramp,
)
from strands_robots.utils import ValidationError

DEGREES = math.degrees(1)

angles = st.floats(-3.1, 3.1)
steep = st.floats(-1.5, 1.5)
metres = st.floats(-0.05, 0.05)
poses = st.builds(HeadPose, x=metres, y=metres, z=metres, roll=angles, pitch=steep, yaw=angles)

tilt = st.floats(-math.radians(30), math.radians(30))
heads = st.builds(HeadPose, roll=tilt, pitch=tilt, yaw=st.floats(-math.pi, math.pi), z=st.floats(-0.03, 0.015))
antennas = st.tuples(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
targets = st.builds(Target, head=heads, body_yaw=st.floats(-2.79, 2.79), antennas=antennas)


@given(poses)
def test_pose_survives_its_matrix(pose: HeadPose) -> None:
    back = HeadPose.from_matrix(pose.matrix())
    assert back.distance_to(pose) == pytest.approx(0, abs=1e-12)
    assert back.angle_to(pose) == pytest.approx(0, abs=1e-6)
    assert back.roll == pytest.approx(pose.roll, abs=1e-6)
    assert back.yaw == pytest.approx(pose.yaw, abs=1e-6)


def test_positive_pitch_looks_down_and_positive_yaw_looks_left() -> None:
    forward = lambda pose: (pose.matrix()[0], pose.matrix()[4], pose.matrix()[8])  # noqa: E731 - the head's x axis
    assert forward(HeadPose(pitch=0.5))[2] < 0
    assert forward(HeadPose(yaw=0.5))[1] > 0


def test_matrix_equals_the_daemons_for_a_recorded_pose() -> None:
    rows = [
        [0.8589596817939296, 0.005327144467848372, 0.5125094014594173, -0.015183067281008027],
        [-0.003996687111117374, 0.9999932666567062, -0.0038069848155070658, 0.0010163894721086145],
        [-0.5125204278105725, 0.0009626717068098321, 0.8589603508544806, -0.05040809340068264],
        [0.0, 0.0, 0.0, 1.0],
    ]
    flat = [value for row in rows for value in row]
    pose = HeadPose.from_matrix(flat)
    assert pose.pitch == pytest.approx(0.538, abs=0.001)
    assert pose.matrix() == pytest.approx(flat, abs=1e-3)


@given(poses, poses)
def test_angle_between_two_heads_is_symmetric_and_at_most_half_a_turn(a: HeadPose, b: HeadPose) -> None:
    assert a.angle_to(b) == pytest.approx(b.angle_to(a), abs=1e-9)
    assert 0 <= a.angle_to(b) <= math.pi + 1e-9
    assert a.angle_to(b) <= a.turn_to(b) + 1e-6


@given(steep, steep)
def test_turn_about_one_axis_measures_its_own_size(a: float, b: float) -> None:
    assert HeadPose(pitch=a).angle_to(HeadPose(pitch=b)) == pytest.approx(abs(a - b), abs=1e-7)


@given(poses, poses, st.floats(0, 1))
def test_interpolation_starts_and_ends_at_its_poses(a: HeadPose, b: HeadPose, share: float) -> None:
    assert a.toward(b, 0) == a
    assert a.toward(b, 1) is b
    middle = a.toward(b, share)
    assert min(a.yaw, b.yaw) - 1e-9 <= middle.yaw <= max(a.yaw, b.yaw) + 1e-9


@pytest.mark.parametrize(
    "flat", [[], [0.0] * 16, [1.0] * 16, [math.nan] * 16, [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 1.0]]
)
def test_matrix_without_a_rotation_is_refused(flat: list[float]) -> None:
    with pytest.raises(ValidationError, match="head pose must"):
        HeadPose.from_matrix(flat)


@given(st.floats(-40, 40))
def test_value_inside_its_bounds_is_converted_to_radians(degrees: float) -> None:
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
def test_any_other_value_is_refused_with_name_unit_and_domain(value: Any) -> None:
    with pytest.raises(ValidationError, match=r"pitch \(degrees\) must be a finite number from -40 to 40, not "):
        bounded("head_pitch", value, unit="degrees", scale=DEGREES, name="pitch")


def test_pitch_and_roll_are_also_bounded_together() -> None:
    check(Target(HeadPose(pitch=math.radians(30), roll=math.radians(-30))), automatic_body_yaw=True)
    with pytest.raises(ValidationError, match="at most 60 degrees, not 61"):
        check(Target(HeadPose(pitch=math.radians(40), roll=math.radians(21))), automatic_body_yaw=True)


def test_head_and_body_are_at_most_65_degrees_apart_without_automatic_body_yaw() -> None:
    apart = Target(HeadPose(yaw=math.radians(70)), 0.0)
    assert check(apart, automatic_body_yaw=True) is apart
    with pytest.raises(ValidationError, match="at most 65 degrees apart"):
        check(apart, automatic_body_yaw=False)
    with pytest.raises(ValidationError, match="at most 65 degrees apart"):
        check(Target(HeadPose(yaw=math.radians(70))), automatic_body_yaw=False, body_yaw=0.0)


def test_action_keeps_the_parts_that_it_does_not_name() -> None:
    start = Target(HeadPose(pitch=0.1, z=0.01), 0.2, (0.3, -0.3))
    target = from_action({"head_yaw": 0.5, "antenna_left": 1.0}, start)
    assert target == Target(HeadPose(pitch=0.1, z=0.01, yaw=0.5), None, (0.3, 1.0))


@given(targets)
def test_target_survives_its_action(target: Target) -> None:
    assume(target.head is not None and abs(target.head.pitch) + abs(target.head.roll) < 1)
    assert from_action(dict(target.action()), Target()) == target
    assert set(target.action()) == set(ACTION_KEYS)


@pytest.mark.parametrize(
    ("action", "reason"),
    [
        ({}, "keys of"),
        ([], "keys of"),
        ({"head_tilt": 1}, "no key 'head_tilt'"),
        ({"head_pitch": math.inf}, "head_pitch must be"),
        ({"antenna_left": None}, "antenna_left must be"),
    ],
)
def test_bad_action_is_refused(action: Any, reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        from_action(action, Target())


@given(targets, targets)
def test_ramp_ends_at_its_target_without_a_jump(start: Target, end: Target) -> None:
    frames = list(ramp(start, end))
    assert frames[-1] is end
    before = start
    for frame in frames:
        assert frame.step_from(before) * FRAME_STEP <= RAMP_STEP * 1.01
        before = frame


@given(targets, st.sampled_from(list(GESTURES.values())))
def test_gesture_stays_inside_the_bounds_and_never_jumps(start: Target, gesture: Gesture) -> None:
    before = start
    for frame in gesture(start):
        check(frame, automatic_body_yaw=True)
        for key, value in frame.action().items():
            bounded(key, value)
        assert frame.step_from(before) <= 1.0
        before = frame.over(before)
