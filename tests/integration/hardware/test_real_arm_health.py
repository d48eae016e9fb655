"""Health of a real arm's motors under LeRobot's driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus

pytestmark = pytest.mark.system


def test_the_warmth_of_every_motor_and_the_unit_of_every_joint(arm: Callable[..., Any], bus: FeetechBus) -> None:
    robot = arm()
    health = robot.get_health()
    assert health["status"] == "success"
    assert len(health["temps"]) == len(bus.servos)
    assert set(health["temps"].values()) == {30.0}
    assert set(robot.joint_units) == set(robot.get_features()["action_features"])
    assert robot.joint_units["gripper.pos"] == "percent"
    assert robot.joint_units["shoulder_pan.pos"] in ("normalized", "degrees")
