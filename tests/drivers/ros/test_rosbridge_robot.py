from __future__ import annotations

from typing import Any

import pytest

from strands_robots.drivers.ros.ackermann_robot import AckermannRosRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.drivers.ros.rtps_robot import RtpsRobot

NO_BOUNDS = [None, 0, -1.0, float("nan"), float("inf"), True, "2"]


@pytest.mark.parametrize("bad", NO_BOUNDS)
@pytest.mark.parametrize("limit", ["max_linear", "max_angular", "max_duration", "publish_rate"])
def test_every_limit_of_a_rosbridge_base_is_required(limit: str, bad: Any) -> None:
    with pytest.raises(ValueError, match=limit):
        RosbridgeRobot("rover", "/cmd_vel", "/odom", **{limit: bad})


@pytest.mark.parametrize("bad", NO_BOUNDS)
@pytest.mark.parametrize("limit", ["wheelbase_m", "max_speed", "max_steering_rad", "max_duration", "publish_rate"])
def test_every_limit_of_a_car_is_required(limit: str, bad: Any) -> None:
    with pytest.raises(ValueError, match=limit):
        AckermannRosRobot("racer", "/servo", **{limit: bad})


@pytest.mark.parametrize("kind", [RosbridgeRobot, RosBridgedRobot])
def test_base_that_needs_odometry_is_refused_without(kind: Any) -> None:
    with pytest.raises(ValueError, match="odom_topic"):
        kind("rover", "/cmd_vel", None)


def test_a_base_of_unknown_limits_may_declare_none() -> None:
    for robot in (RosBridgedRobot("a", "/cmd_vel", "/odom"), RtpsRobot("b", "/cmd_vel")):
        assert (robot.max_linear, robot.max_angular, robot.max_duration) == (None, None, None)
        assert len(robot.tools) >= 3
