"""A mobile base as a device, without a network."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.driver_bench import DriverBench
from fixtures.ros_memory import MemoryLink

from strands_robots.device_connect.bringup import driver_for
from strands_robots.device_connect.robot_driver import MobileBaseDeviceDriver
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.safety.authorization import Approval, Authorization

SHUT = CommandGate(lambda _: (), lambda: False)


@pytest.fixture
def base() -> Iterator[MobileBaseRobot]:
    robot = MobileBaseRobot("rover", MemoryLink(), "/cmd_vel", publish_rate=100, command_gate=SHUT)
    yield robot
    robot.disconnect()


def driver(base: MobileBaseRobot, approved: bool = True) -> MobileBaseDeviceDriver:
    return MobileBaseDeviceDriver(
        base,
        authorization=Authorization(hardware=True, read_list=lambda _: ("operator",), robot="bench-1"),
        approval=Approval(lambda _: ("drive",) if approved else (), lambda: False),
    )


def sent(base: MobileBaseRobot) -> list[float]:
    assert isinstance(base.link, MemoryLink)
    return [message["linear"]["x"] for _, message in base.link.sent]


async def test_drive_starts_and_returns_and_its_end_is_told(base: MobileBaseRobot) -> None:
    seen = threading.Event()
    base.link.watch("/cmd_vel", None, lambda _: seen.wait(60) and None)
    async with DriverBench(driver(base)) as bench:
        answer = await bench.call("drive", linear=0.5, angular=0.0, duration=0.2)
        assert answer["status"] == "success"
        assert (await bench.call("getStatus"))["task_status"] == "running"
        seen.set()
        await bench.until(lambda: bench.of("taskComplete"))
        assert bench.of("taskComplete")[0]["steps"] == 20
        assert sent(base) == [0.5] * 20 + [0.0]


async def test_stop_ends_a_drive_for_every_caller(base: MobileBaseRobot) -> None:
    async with DriverBench(driver(base)) as bench:
        await bench.call("drive", linear=0.5, angular=0.0, duration=30.0)
        assert (await bench.call("stop", "stranger"))["halted"] == ["drive"]
        assert (await bench.call("getStatus"))["task_status"] == "stopped"


@pytest.mark.parametrize(
    "bad", [{"linear": "1"}, {"angular": float("nan")}, {"duration": 0}, {"duration": 3601}, {"linear": True}]
)
async def test_an_argument_outside_its_domain_sends_nothing(base: MobileBaseRobot, bad: dict[str, Any]) -> None:
    async with DriverBench(driver(base)) as bench:
        answer = await bench.call("drive", **{"linear": 0.1, "angular": 0.0, "duration": 1.0, **bad})
        assert next(iter(bad)) in answer["reason"]
    assert 0.1 not in sent(base)


async def test_a_drive_needs_the_callers_name_and_the_operators_leave(base: MobileBaseRobot) -> None:
    speeds = {"linear": 0.1, "angular": 0.0, "duration": 1.0}
    async with DriverBench(driver(base)) as bench:
        assert (await bench.call("drive", "stranger", **speeds))["status"] == "error"
    async with DriverBench(driver(base, approved=False)) as bench:
        assert "operator approval" in (await bench.call("drive", **speeds))["reason"]
    assert 0.1 not in sent(base)


def test_a_base_gets_this_driver_and_everything_is_described(base: MobileBaseRobot) -> None:
    made = driver_for(base, "robot")
    assert isinstance(made, MobileBaseDeviceDriver)
    schema = next(f for f in made.functions if f.name == "drive").parameters
    assert schema["required"] == ["linear", "angular", "duration"]
    assert all(len(prop["description"]) > 10 for prop in schema["properties"].values())
