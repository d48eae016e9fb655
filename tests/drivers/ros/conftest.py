"""Bases over links in memory, disconnected when a test has ended, and patience for their halts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.ros_bases import OPEN, TOPIC, Made
from fixtures.ros_memory import MemoryLink

from strands_robots.drivers.ros.mobile_base import MobileBaseRobot, PosedBaseRobot


@pytest.fixture(autouse=True)
def patient(patient_halts: None) -> None:
    """No test here fails because the machine was busy when something halted."""


@pytest.fixture
def made() -> Iterator[Made]:
    robots: list[MobileBaseRobot] = []

    def make(link: MemoryLink | None = None, **options: Any) -> MobileBaseRobot:
        options = {"publish_rate": 1000.0, "command_gate": OPEN, **options}
        robots.append(PosedBaseRobot("rover", link or MemoryLink(), TOPIC, **options))
        return robots[-1]

    yield make
    for robot in robots:
        robot.disconnect()
