"""A real arm's joint that meets a fixed thing ends its motion, seen by its lag on emulated servos."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus


@pytest.mark.parametrize("speed", [0.25, 1.0])
def test_joint_that_meets_a_fixed_thing_ends_the_motion_by_its_name(arm: Any, bus: FeetechBus, speed: float) -> None:
    robot = arm(use_degrees=True)
    start = bus.servos[1].shaft
    bus.servos[1].blocked_at = start + 200
    first = robot.move_joints({"shoulder_pan": 60.0}, speed=speed)
    assert first["status"] == "error"
    assert first["why"].startswith("shoulder_pan was blocked at 17 degrees"), first
    bus.servos[1].blocked_at = None
    free = robot.move_joints({"shoulder_pan": 40.0}, speed=speed)
    assert free["why"] == "it is done"
