"""Each class of base as a device: driven, locked by an emergency stop, held by zeros, freed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
from fixtures.driver_bench import DriverBench
from fixtures.planes import own_plane
from fixtures.ros_memory import MemoryLink

from strands_robots.device_connect.bringup import driver_for
from strands_robots.device_connect.robot_driver import MobileBaseDeviceDriver
from strands_robots.drivers.ros import rtps_robot, velocity
from strands_robots.drivers.ros.ackermann_robot import AckermannRosRobot
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.safety.authorization import Approval, Authorization
from strands_robots.safety.orders import StopOrder
from strands_robots.safety.plane import SafetyPlane

TOPIC, ODOM = "/cmd", "/odom"
SHUT = CommandGate(lambda _: (), lambda: False)
DRIVE = {"linear": 0.5, "angular": 0.0, "duration": 30.0}
EPOCH = "e" * 32


class Far(MemoryLink):
    """A graph whose base does at once what it is told, and tells so on its odometry topic."""

    domain_id = 0

    def __init__(self) -> None:
        super().__init__()
        self.watch(TOPIC, None, lambda message: self._tell(speed_of(message)))

    def speeds(self) -> list[float]:
        """What was commanded so far, forwards."""
        return [speed_of(message) for topic, message in list(self.sent) if topic == TOPIC]

    def _tell(self, speed: float) -> None:
        twist = {"linear": {"x": speed, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
        self.publish(ODOM, "nav_msgs/msg/Odometry", {"twist": {"twist": twist}})


def speed_of(message: Mapping[str, Any]) -> float:
    return float(message["throttle"] if "throttle" in message else message["linear"]["x"])


def over_dds(link: Far, monkeypatch: pytest.MonkeyPatch) -> MobileBaseRobot:
    monkeypatch.setattr(rtps_robot, "DdsLink", lambda *_, **__: link)
    return rtps_robot.RtpsRobot("rover", TOPIC, odom_topic=ODOM, publish_rate=100.0, command_gate=SHUT)


def bridged(kind: Any, link: Far) -> MobileBaseRobot:
    made: MobileBaseRobot = kind("rover", TOPIC, ODOM, link=link, publish_rate=100.0, command_gate=SHUT)
    return made


MAKERS: dict[str, Callable[[Far, pytest.MonkeyPatch], MobileBaseRobot]] = {
    "RosBridgedRobot": lambda link, _: bridged(RosBridgedRobot, link),
    "RosbridgeRobot": lambda link, _: bridged(RosbridgeRobot, link),
    "RtpsRobot": over_dds,
    "AckermannRosRobot": lambda link, _: AckermannRosRobot(
        "rover", TOPIC, link=link, max_duration=60.0, max_speed=1.0, publish_rate=100.0, command_gate=SHUT
    ),
}


@pytest.fixture
def plane() -> Iterator[SafetyPlane]:
    with own_plane(20.0) as here:
        yield here


@pytest.mark.parametrize("kind", MAKERS)
async def test_a_locked_base_of_every_class_gets_zeros_and_nothing_else_until_it_is_freed(
    kind: str, plane: SafetyPlane, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(velocity, "BLIND_HOLD_S", 0.2)
    link = Far()
    base = MAKERS[kind](link, monkeypatch)
    assert isinstance(driver_for(base, "robot"), MobileBaseDeviceDriver)
    driver = MobileBaseDeviceDriver(
        base,
        authorization=Authorization(hardware=True, read_list=lambda _: ("operator",), robot="bench-1"),
        approval=Approval(lambda _: ("drive",), lambda: False),
    )
    plane.register("bench-1", base)
    try:
        async with DriverBench(driver) as bench:
            assert (await bench.call("drive", **DRIVE))["status"] == "success"
            await bench.until(lambda: 0.5 in link.speeds())
            order = StopOrder(EPOCH, "console", "test")
            report = (await asyncio.to_thread(plane.emergency_stop, order))["bench-1"]
            locked_at = len(link.speeds())
            assert report.verdict.stopped is True
            assert "drive" in report.verdict.halted
            assert EPOCH in (await bench.call("drive", **DRIVE))["reason"]
            assert EPOCH in base.drive(0.5)["reason"]
            assert (await bench.call("stop", "stranger"))["stopped"] is True
            await bench.until(lambda: not base.holding)
            assert set(link.speeds()[locked_at:]) == {0.0}
            assert "bench-1" in plane.clear_local("test")
            assert set(link.speeds()[locked_at:]) == {0.0}, "to be freed is not to move"
            assert (await bench.call("drive", **DRIVE))["status"] == "success"
            await bench.until(lambda: link.speeds()[-1] == 0.5)
            assert (await bench.call("stop"))["halted"] == ["drive"]
    finally:
        base.disconnect()
