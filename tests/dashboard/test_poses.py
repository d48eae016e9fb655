"""The 3-D pose of a real arm: its calibrated joints as the model's, drawn by a process that lives while it is asked."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import math
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fixtures.page_feed import PageFeed
from fixtures.waiting import eventually
from PIL import Image

from strands_robots.dashboard import pictures as module
from strands_robots.dashboard.pictures import Poses
from strands_robots.dashboard.pose_process import PosePainter, main
from strands_robots.envelope import error, success
from strands_robots.hardware.robot import HardwareRobot
from strands_robots.kinematics.chain import built_in
from strands_robots.utils import ValidationError

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
COUNTS = (796, 3299)
"""Ends of every joint's calibration: 220 degrees, as the model turns; 100 of the driver's units are half of it."""

UNIT_RAD = math.radians((COUNTS[1] - COUNTS[0]) / 2 * 360 / 4095) / 100
PROGRAM = module.PROGRAM


class Follower:
    """Stand-in for LeRobot's follower that tells normalized positions."""

    name = "so101_follower"
    is_connected = True

    def __init__(self) -> None:
        entry = SimpleNamespace(range_min=COUNTS[0], range_max=COUNTS[1], drive_mode=0)
        turning = SimpleNamespace(range_min=0, range_max=4095, drive_mode=0)
        modes = dict.fromkeys(MOTORS, "RANGE_M100_100") | {"gripper": "RANGE_0_100"}
        self.bus = SimpleNamespace(
            motors={
                motor: SimpleNamespace(norm_mode=SimpleNamespace(name=mode), model="sts3215")
                for motor, mode in modes.items()
            },
            calibration=dict.fromkeys(MOTORS, entry) | {"wrist_roll": turning},
            sync_read=lambda *_, **__: {motor: self.positions[f"{motor}.pos"] for motor in MOTORS},
        )
        self.positions = {f"{motor}.pos": 0.0 for motor in MOTORS}
        self.action_features = self.observation_features = dict.fromkeys(self.positions, float)

    def connect(self, calibrate: bool = True) -> None:
        """It is connected."""

    def disconnect(self) -> None:
        """It stays connected."""

    def get_observation(self) -> dict[str, float]:
        return dict(self.positions)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        return action


class ArmFeed(PageFeed):
    """A network of one robot, whose ``getPose`` is answered by the arm itself."""

    def __init__(self, robot: HardwareRobot) -> None:
        super().__init__()
        self._robot = robot

    async def call(self, robot: str, verb: str, params: Any, seconds: float) -> Any:
        assert verb == "getPose"
        return self._robot.arm_pose()


@pytest.fixture
def follower() -> Follower:
    return Follower()


@pytest.fixture
def arm(follower: Follower) -> Iterator[HardwareRobot]:
    robot = HardwareRobot(follower, "arm-1")
    yield robot
    robot.cleanup()


def drawn(answer: Any) -> Any:
    assert answer["status"] == "success", answer
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(answer["jpeg"]))).convert("RGB"), dtype=np.int16)


def ended(program: Poses) -> bool:
    return program._process is None


def test_joints_of_a_real_arm_become_the_angles_of_its_model(arm: HardwareRobot, follower: Follower) -> None:
    follower.positions |= {"shoulder_pan.pos": 50.0, "elbow_flex.pos": -20.0, "gripper.pos": 40.0}
    pose = arm.arm_pose()
    assert pose["model"] == "so101"
    painter = PosePainter(pose["model"])
    found = painter.positions(pose["joints"], pose["gripper"])
    painter.close()
    jaw = built_in("so101").gripper
    assert jaw is not None
    assert found["shoulder_pan"] == pytest.approx(50 * UNIT_RAD, abs=1e-4)
    assert found["elbow_flex"] == pytest.approx(-20 * UNIT_RAD, abs=1e-4)
    assert found["shoulder_lift"] == pytest.approx(0.0)
    assert found[jaw.joint.name] == pytest.approx(jaw.joint.low + 0.4 * (jaw.joint.high - jaw.joint.low))


def test_pose_is_drawn_by_another_process_and_follows_the_arm(arm: HardwareRobot, follower: Follower) -> None:
    async def looked() -> tuple[Any, Any, Any]:
        pictures, feed = Poses(), ArmFeed(arm)
        try:
            first, again = await pictures.picture(feed, "arm-1"), await pictures.picture(feed, "arm-1")
            follower.positions["shoulder_pan.pos"] = 60.0
            await asyncio.sleep(0.2)  # an observation counts as fresh for as long
            return drawn(first), drawn(again), drawn(await pictures.picture(feed, "arm-1"))
        finally:
            pictures.close()
            await asyncio.to_thread(eventually, lambda: ended(pictures), 20.0, what="the end of the process")

    first, again, turned = asyncio.run(looked())
    assert first.shape == (480, 640, 3)
    assert np.array_equal(first, again)
    moved = np.abs(first - turned).max(axis=2) > 60
    assert moved.mean() > 0.01, "the arm is elsewhere in the picture"
    assert moved.mean() < 0.5, "and the floor is where it was"


def test_process_ends_when_nobody_looks_and_comes_back(arm: HardwareRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "IDLE_S", 0.1)

    async def looked() -> None:
        pictures, feed = Poses(), ArmFeed(arm)
        for _ in range(2):
            drawn(await pictures.picture(feed, "arm-1"))
            await asyncio.to_thread(eventually, lambda: ended(pictures), 20.0, what="the end of the process")
        pictures.close()

    asyncio.run(looked())


def refused(feed: PageFeed, *program: str) -> str:
    async def looked() -> Any:
        pictures = Poses()
        try:
            return await pictures.picture(feed, "arm-1")
        finally:
            pictures.close()

    module.PROGRAM = program or PROGRAM
    try:
        answer = asyncio.run(looked())
    finally:
        module.PROGRAM = PROGRAM
    assert answer["status"] == "error"
    return str(answer["reason"])


WITHOUT_MUJOCO = (
    "import sys; sys.modules['mujoco'] = None\n"
    "from strands_robots.dashboard.pose_process import main\n"
    "main(sys.stdin, sys.stdout)"
)


def test_what_is_missing_is_said(arm: HardwareRobot) -> None:
    assert "needs the [sim] extra" in refused(ArmFeed(arm), sys.executable, "-c", WITHOUT_MUJOCO)


def test_process_that_dies_is_said_and_takes_nothing_along(arm: HardwareRobot) -> None:
    assert "ended" in refused(ArmFeed(arm), sys.executable, "-c", "pass")


def test_process_that_cannot_start_is_said(arm: HardwareRobot) -> None:
    assert "cannot start" in refused(ArmFeed(arm), "/nothing/is/here")


POSED = success("here", model="so101", joints={}, gripper=0.5)


def test_close_ends_a_process_that_is_stuck_and_starts_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PROGRAM", (sys.executable, "-c", "import sys; sys.stdin.read()"))
    monkeypatch.setattr(module, "DRAW_S", 3600.0)

    async def looked() -> list[Any]:
        pictures, feed = Poses(), PageFeed()
        feed.answers["getPose"] = [POSED]
        both = [asyncio.create_task(pictures.picture(feed, name)) for name in ("arm-1", "arm-2")]
        await asyncio.to_thread(eventually, lambda: pictures._process is not None, 60.0, what="the process")
        pictures.close()
        answers = await asyncio.wait_for(asyncio.gather(*both), 60.0)
        await asyncio.to_thread(eventually, lambda: ended(pictures), 60.0, what="the end of the process")
        pictures.close()
        return [*answers, await pictures.picture(feed, "arm-1")]

    assert [answer["status"] for answer in asyncio.run(looked())] == ["error"] * 3


def test_robot_that_answers_after_the_close_is_not_drawn() -> None:
    async def looked() -> Any:
        pictures, feed = Poses(), PageFeed()
        feed.answers["getPose"], feed.slow["getPose"] = [POSED], asyncio.Event()
        waiting = asyncio.create_task(pictures.picture(feed, "arm-1"))
        await asyncio.to_thread(eventually, lambda: feed.calls, 60.0, what="the question")
        pictures.close()
        feed.slow["getPose"].set()
        return await waiting

    assert asyncio.run(looked())["reason"] == module.CLOSED


def test_robot_without_a_model_says_why() -> None:
    feed = PageFeed()
    feed.answers["getPose"] = [error("no model of reachy is known; give model, an MJCF file of the arm.")]
    assert refused(feed).startswith("no model of reachy")


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        ({"joints": {}}, "model must be one of so100, so101"),
        ({"model": "../../etc/passwd", "joints": {}}, "model must be one of so100, so101"),
        ({"model": "so101", "joints": 7}, "joints must be an object"),
        ({"model": "so101", "joints": {"shoulder_pan": 1.0}}, "does not report its joint shoulder_lift"),
        ({"model": "so101", "joints": dict.fromkeys(MOTORS, math.nan)}, "shoulder_pan must be a finite number"),
        ({"model": "so101", "joints": dict.fromkeys(MOTORS, True)}, "shoulder_pan must be a finite number"),
        ({"model": "so101", "joints": dict.fromkeys(MOTORS, 0.0), "gripper": "open"}, "gripper must be"),
    ],
)
def test_pose_that_makes_no_sense_is_refused_by_name(pose: dict[str, Any], why: str) -> None:
    answers = io.StringIO()
    main(io.StringIO(json.dumps({**success("here", **pose), "width": 64, "height": 48}) + "\n"), answers)
    assert why in json.loads(answers.getvalue())["error"]


def test_joint_that_is_missing_is_named() -> None:
    painter = PosePainter("so100")
    with pytest.raises(ValidationError, match="shoulder_pan"):
        painter.positions({}, None)
    painter.close()
