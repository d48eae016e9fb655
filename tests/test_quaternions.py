"""One sign and one yaw for every quaternion that is told."""

from __future__ import annotations

import math

import pytest

from strands_robots.quaternions import w_positive, yaw_of


@pytest.mark.parametrize("yaw", [-3.0, -0.5, 0.0, 1.0, 3.1])
@pytest.mark.parametrize("scale", [1.0, -1.0, 2.5])
def test_the_yaw_of_a_rotation_about_z_is_told_whatever_its_sign_and_length(yaw: float, scale: float) -> None:
    quat = [scale * math.cos(yaw / 2), 0.0, 0.0, scale * math.sin(yaw / 2)]
    assert yaw_of(quat) == pytest.approx(yaw)


def test_the_yaw_is_the_heading_of_the_x_axis_when_the_body_pitches_as_well() -> None:
    yaw, pitch = 0.7, 0.4
    a, b = yaw / 2, pitch / 2
    quat = [math.cos(a) * math.cos(b), -math.sin(a) * math.sin(b), math.cos(a) * math.sin(b), math.sin(a) * math.cos(b)]
    assert yaw_of(quat) == pytest.approx(yaw)


def test_of_the_two_quaternions_of_a_rotation_the_one_with_a_positive_w_is_told() -> None:
    assert w_positive((-0.5, 0.5, -0.5, 0.5)) == [0.5, -0.5, 0.5, -0.5]
    assert w_positive((0.0, 1.0, 0.0, 0.0)) == [0.0, 1.0, 0.0, 0.0]
