"""A base driven by hand from the page: our rover in MuJoCo behind a DDS node, moved by mouse and by key."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from fixtures.base_process import base_process
from fixtures.page_driving import answer, hold_until, take
from fixtures.page_site import picture
from fixtures.ros_bases import OPEN
from fixtures.waiting import eventually

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]
DOMAIN = 84


@pytest.fixture
def rover(cell: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The driver of the rover, served as base-1."""
    pytest.importorskip("cyclonedds")
    from strands_robots.device_connect import init_device_connect_sync, stop_device_connect  # noqa: PLC0415
    from strands_robots.drivers.ros.rtps_robot import RtpsRobot  # noqa: PLC0415 - needs cyclonedds

    confined = {"ROS_LOCALHOST_ONLY": "1", "STRANDS_ROBOT_COMMAND_ALLOW": "drive,acquireControl"}
    for name, value in {**cell.settings, **confined}.items():
        monkeypatch.setenv(name, value)
    with base_process(DOMAIN, "fixtures.mujoco_base"), ThreadPoolExecutor(1) as beside:
        robot = RtpsRobot("rover", "/cmd_vel", odom_topic="/odom", domain_id=DOMAIN, publish_rate=20, command_gate=OPEN)
        # Playwright's loop counts as running on this thread.
        runtime = beside.submit(
            init_device_connect_sync, robot, peer_id="base-1", link=cell.link, allow_insecure=True
        ).result(60)
        yield robot
        beside.submit(stop_device_connect, runtime).result(60)
        robot.disconnect()


def speed_of(rover: Any, part: str, axis: str) -> float:
    read = rover.get_pose(20.0)
    assert read["status"] == "success", read
    return float(read["message"]["twist"]["twist"][part][axis])


@pytest.mark.parametrize(
    ("label", "key", "part", "axis", "sign"),
    [("forward", "", "linear", "x", 1), ("turn left", "w", "angular", "z", 1)],
)
def test_base_rolls_while_it_is_held_and_stands_when_it_is_let_go(
    cell: Any, rover: Any, label: str, key: str, part: str, axis: str, sign: int
) -> None:
    page = cell.open(cell.serve_page(), robots=1)
    button = take(page, label, "base-1")
    hold_until(page, button, lambda: speed_of(rover, part, axis) * sign > 0.05, "the rover rolls", key)
    picture(page, f"base-{part}")
    if key:
        page.keyboard.up(key)
    else:
        page.mouse.up()
    page.locator(".drive .said", has_text="Stopped (").wait_for()
    eventually(lambda: abs(speed_of(rover, part, axis)) < 0.01, what="the rover stands")
    page.get_by_role("button", name="Give control back").click()
    page.get_by_text("nobody holds control").wait_for()
    page.keyboard.press("Space")
    answer(page, "base-1", "stopped")
