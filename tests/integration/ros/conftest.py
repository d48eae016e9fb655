"""Fixtures of all graph tests: DDS that stays on this machine."""

from __future__ import annotations

import pytest
from fixtures.waiting import eventually

from strands_robots.drivers.ros.mobile_base import PosedBaseRobot


@pytest.fixture(autouse=True)
def confined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow for a base that is starved of its processor and answers a stop late."""
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "4")


def x_of(robot: PosedBaseRobot) -> float:
    """Return the base's x position in metres."""
    return float(robot.get_pose(20.0)["message"]["pose"]["pose"]["position"]["x"])


def obeyed(robot: PosedBaseRobot) -> None:
    """Return once the base has moved on a drive and is still: a message before its reader knows us is lost."""
    began = x_of(robot)

    def moved() -> bool:
        robot.drive(0.2, 0.0, duration=0.1)
        return x_of(robot) > began

    eventually(moved)
    eventually(lambda: robot.stop()["stopped"])
