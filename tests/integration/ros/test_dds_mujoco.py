"""The loop closed through physics: our rover's motors in MuJoCo behind a DDS node, driven from here."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.base_process import base_process
from fixtures.ros_bases import OPEN
from fixtures.waiting import eventually
from tests.integration.ros.conftest import obeyed, x_of

from strands_robots.drivers.ros.rtps_robot import RtpsRobot

DOMAIN = 82
ROOT = Path(__file__).resolve().parents[3]
DRIVER = f"""
from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.ros.gate import CommandGate
gate = CommandGate(lambda _: ("cmd_vel",), lambda: False)
lost = RtpsRobot("lost", "/cmd_vel", domain_id={DOMAIN}, publish_rate=20, command_gate=gate)
while "No subscription" in str(lost.drive(0.4, 0.0, duration=60.0)):
    pass
"""


@pytest.fixture
def world() -> Iterator[None]:
    with base_process(DOMAIN, "fixtures.mujoco_base"):
        yield


@pytest.fixture
def driver() -> Iterator[RtpsRobot]:
    made = RtpsRobot("rover", "/cmd_vel", odom_topic="/odom", domain_id=DOMAIN, publish_rate=20, command_gate=OPEN)
    yield made
    made.disconnect()


def speed_of(robot: RtpsRobot) -> float:
    return float(robot.get_pose(20.0)["message"]["twist"]["twist"]["linear"]["x"])


@pytest.mark.usefixtures("patient")
def test_base_drives_the_commanded_distance(world: None, driver: RtpsRobot) -> None:
    obeyed(driver)
    began = x_of(driver)
    called = time.monotonic()
    answer = driver.drive(0.3, 0.0, duration=2.0)
    took_s = time.monotonic() - called
    assert (answer["status"], answer["messages"], answer["trailing_zero"]) == ("success", 40, True)
    eventually(lambda: driver.stop()["stopped"])
    # 0.6 m on a machine that keeps the time; a burst that is held up holds its velocity for as long.
    assert x_of(driver) - began == pytest.approx(0.3 * max(2.0, took_s), rel=0.05)


def test_base_stops_when_its_link_is_lost(world: None, driver: RtpsRobot) -> None:
    # A driver that is gone without a word: no zero and no stop, as when a cable is pulled.
    with subprocess.Popen([sys.executable, "-c", DRIVER], cwd=ROOT) as lost:
        try:
            eventually(lambda: speed_of(driver) > 0.3)
        finally:
            lost.kill()
    eventually(lambda: abs(speed_of(driver)) < 0.01)
    stood = x_of(driver)
    assert x_of(driver) == pytest.approx(stood, abs=0.005)
