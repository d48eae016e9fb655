"""LeRobot's driver on emulated servos: the page draws the arm as its servos stand."""

from __future__ import annotations

import asyncio
import base64
import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from fixtures.feetech_bus import FeetechBus, arm_calibration
from fixtures.page_feed import PageFeed
from PIL import Image

from strands_robots.dashboard.pose_process import PosePainter
from strands_robots.dashboard.poses import Poses

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


class ArmFeed(PageFeed):
    """A network whose one robot answers ``getPose`` itself."""

    def __init__(self, robot: Any) -> None:
        super().__init__()
        self._robot = robot

    async def call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Any:
        assert verb == "getPose"
        return await asyncio.to_thread(self._robot.arm_pose)


def angles(bus: FeetechBus) -> list[float]:
    """Radians of the model at which the servos stand, by their counts."""
    entries, shafts, found = arm_calibration(), bus.shafts(), []
    for servo, joint in enumerate(JOINTS, 1):
        middle = (entries[joint]["range_min"] + entries[joint]["range_max"]) / 2
        found.append(math.radians((shafts[servo] - entries[joint]["homing_offset"] - middle) * 360 / 4095))
    return found


@pytest.mark.parametrize("use_degrees", [True, False])
def test_page_draws_a_real_arm_as_its_servos_stand(arm: Any, bus: FeetechBus, use_degrees: bool) -> None:
    robot = arm(use_degrees=use_degrees)

    async def looked() -> list[Any]:
        pictures, feed = Poses(), ArmFeed(robot)
        try:
            found = []
            for pan in (0.0, 60.0):
                moved = await asyncio.to_thread(robot.move_joints, {"shoulder_pan": pan}, 1.0)
                assert moved["status"] == "success", moved
                answer = await pictures.picture(feed, "arm-1")
                assert answer["status"] == "success", answer
                found.append(Image.open(io.BytesIO(base64.b64decode(answer["jpeg"]))).convert("RGB"))
            return found
        finally:
            pictures.close()

    ahead, aside = asyncio.run(looked())
    assert ahead.size == (640, 480)
    apart = np.abs(np.asarray(ahead, np.int16) - np.asarray(aside, np.int16)).max(axis=2) > 60
    assert 0.01 < apart.mean() < 0.5, "the arm turned, and the floor did not"
    pose = robot.arm_pose()
    painter = PosePainter(pose["model"])
    drawn = painter.positions(pose["joints"], pose["gripper"])
    painter.close()
    assert [drawn[joint] for joint in JOINTS] == pytest.approx(angles(bus), abs=0.02)
