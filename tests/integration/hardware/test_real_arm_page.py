"""LeRobot's driver on emulated servos: the page draws the arm as its servos stand."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.command_line import Machine
from fixtures.feetech_bus import FeetechBus, arm_calibration
from fixtures.page_feed import PageFeed, page_robot
from fixtures.waiting import until
from PIL import Image

from strands_robots.dashboard.driving import HandControl
from strands_robots.dashboard.pictures import Poses
from strands_robots.dashboard.pose_process import PosePainter
from strands_robots.device_connect import FleetClient, loopback_config

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


class NetworkFeed(PageFeed):
    """A network with one robot, as the page reaches it."""

    def __init__(self, fleet: FleetClient) -> None:
        super().__init__()
        self._fleet = fleet

    async def call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Any:
        self.calls.append((robot, verb, dict(params)))
        return await asyncio.to_thread(self._fleet.call, robot, verb, dict(params))

    async def stop(self, robot: str) -> Any:
        return await asyncio.to_thread(self._fleet.stop, robot)


async def jogged(fleet: FleetClient, axis: str, moved: Callable[[], bool]) -> list[dict[str, Any]]:
    """Take control, hold a jog until it has moved the arm, let go; return what the page was told."""
    told: list[dict[str, Any]] = []
    robot = page_robot(NetworkFeed(fleet), "arm-1")
    hand = HandControl(told.append)
    try:
        taken = await hand.take("dc:arm-1", robot)
        assert taken["status"] == "success", taken

        def ended() -> bool:
            return any(each["type"] == "jogged" for each in told)

        async with asyncio.timeout(60):
            while not ended() and not await asyncio.to_thread(moved):
                # On a busy machine a beat may be late, which ends the jog.
                if not hand.begin("dc:arm-1", {"kind": "joint", "axis": axis, "direction": 1, "speed": 0.5}):
                    await asyncio.sleep(0)
                hand.beat("dc:arm-1")
                await asyncio.sleep(0.02)
            hand.release("dc:arm-1")
            await until(ended, what="the end of the jog")
    finally:
        await hand.leave()
    return told


def test_joint_buttons_of_the_page_move_an_arm_that_is_served_for_them(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    ends = ["--emulated", "--drive-by-page", "--json", "--until-stdin-closes"]
    process = machine.start("serve", "so101", "--peer-id", "arm-1", *ends)
    try:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        assert ready["event"] == "serving", ready
        with FleetClient(loopback_config(int(machine.environment["STRANDS_DC_PORT"])), "dashboard") as fleet:

            def pan() -> float:
                return float(fleet.call("arm-1", "getState")["joints"]["shoulder_pan.pos"])

            start = pan()
            told = asyncio.run(jogged(fleet, "shoulder_pan.pos", lambda: pan() > start + 5))
            assert [each["refused"] for each in told if each["type"] == "jogged"][-1:] == [False], told
            assert pan() > start + 4
            refused = fleet.call("arm-1", "execute", {"instruction": "wave"})
            assert refused["status"] == "error", "the flag approves what the page needs and no more"
        process.communicate(timeout=60)
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()


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
