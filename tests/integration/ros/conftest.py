"""What every test of a graph gets: DDS that stays on this machine."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fixtures.waiting import eventually

from strands_robots.drivers.ros.mobile_base import MobileBaseRobot


@pytest.fixture(autouse=True)
def confined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A far end that is starved of its processor brakes and speaks later than a second after a stop."""
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "4")


def obeyed(robot: MobileBaseRobot, x_of: Callable[[], float]) -> None:
    """Return once the base has moved on a drive and stands: what is sent before its reader knows us reaches nobody."""
    began = x_of()

    def moved() -> bool:
        robot.drive(0.2, 0.0, duration=0.1)
        return x_of() > began

    eventually(moved)
    eventually(lambda: robot.stop()["stopped"])
