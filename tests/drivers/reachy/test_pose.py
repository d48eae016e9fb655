"""Head poses and their matrices."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.drivers.reachy.pose import HeadPose
from strands_robots.utils import ValidationError

angles = st.floats(-3.1, 3.1)
tilts = st.floats(-1.5, 1.5)
metres = st.floats(-0.05, 0.05)
poses = st.builds(HeadPose, x=metres, y=metres, z=metres, roll=angles, pitch=tilts, yaw=angles)


@given(poses)
def test_a_pose_survives_its_matrix(pose: HeadPose) -> None:
    back = HeadPose.from_matrix(pose.matrix())
    assert back.distance_to(pose) == pytest.approx(0, abs=1e-12)
    assert back.angle_to(pose) == pytest.approx(0, abs=1e-6)
    assert back.roll == pytest.approx(pose.roll, abs=1e-6)
    assert back.yaw == pytest.approx(pose.yaw, abs=1e-6)


def test_positive_pitch_looks_down_and_positive_yaw_looks_left() -> None:
    forward = lambda pose: (pose.matrix()[0], pose.matrix()[4], pose.matrix()[8])  # noqa: E731 - the head's x axis
    assert forward(HeadPose(pitch=0.5))[2] < 0
    assert forward(HeadPose(yaw=0.5))[1] > 0


def test_the_matrix_is_the_daemons_own_for_a_recorded_pose() -> None:
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
def test_the_angle_between_two_heads_is_the_same_both_ways_and_at_most_half_a_turn(a: HeadPose, b: HeadPose) -> None:
    assert a.angle_to(b) == pytest.approx(b.angle_to(a), abs=1e-9)
    assert 0 <= a.angle_to(b) <= math.pi + 1e-9
    assert a.angle_to(b) <= a.turn_to(b) + 1e-6


@given(tilts, tilts)
def test_a_turn_about_one_axis_measures_its_own_size(a: float, b: float) -> None:
    assert HeadPose(pitch=a).angle_to(HeadPose(pitch=b)) == pytest.approx(abs(a - b), abs=1e-7)


@given(poses, poses, st.floats(0, 1))
def test_the_way_from_one_to_the_other_begins_and_ends_there(a: HeadPose, b: HeadPose, share: float) -> None:
    assert a.toward(b, 0) == a
    assert a.toward(b, 1) is b
    middle = a.toward(b, share)
    assert min(a.yaw, b.yaw) - 1e-9 <= middle.yaw <= max(a.yaw, b.yaw) + 1e-9


@pytest.mark.parametrize(
    "flat", [[], [0.0] * 16, [1.0] * 16, [math.nan] * 16, [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 1.0]]
)
def test_numbers_that_hold_no_rotation_are_refused(flat: list[float]) -> None:
    with pytest.raises(ValidationError, match="head pose must"):
        HeadPose.from_matrix(flat)
