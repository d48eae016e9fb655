"""A drive, and the next one as soon as it is told to be over."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.memory import MemoryLink

OPEN = CommandGate(lambda _: ("cmd_vel",), lambda: False)


@pytest.fixture
def restless() -> Iterator[None]:
    """Threads take turns so often that none does two things in one turn."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("restless")
def test_a_base_whose_drive_is_told_to_be_over_takes_the_next_one() -> None:
    link = MemoryLink()
    link.watch("/cmd_vel", "geometry_msgs/msg/Twist", lambda message: None)
    robot = MobileBaseRobot("rover", link, "/cmd_vel", publish_rate=1000.0, command_gate=OPEN)
    try:
        for _ in range(300):
            answer = robot.start_drive(0.1, 0.0, 0.001)
            assert answer["status"] == "success", answer
            while robot.get_task_status()["task_status"] == "running":
                pass
    finally:
        robot.disconnect()
