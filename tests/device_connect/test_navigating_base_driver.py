"""A base with a navigation stack as a device, without a network."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.driver_bench import DriverBench
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import until

from strands_robots.device_connect.bringup import driver_for
from strands_robots.device_connect.robot_driver import MobileBaseDeviceDriver, NavigatingBaseDeviceDriver
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import Goal
from strands_robots.safety.authorization import Approval, Authorization

NAV = "/navigate_to_pose"
SHUT = CommandGate(lambda _: (), lambda: False)
STANDING = {"twist": {"twist": {"linear": {"x": 0.0}, "angular": {"z": 0.0}}}}


@pytest.fixture
def goals() -> list[Goal]:
    return []


@pytest.fixture
def base(goals: list[Goal]) -> Iterator[RosBridgedRobot]:
    link = MemoryLink()
    link.serve(NAV, lambda goal, feedback, sent: goals.append(sent))
    link.watch("/cmd_vel", None, lambda _: link.publish("/odom", "nav_msgs/msg/Odometry", STANDING))
    robot = RosBridgedRobot("rover", "/cmd_vel", "/odom", nav_action=NAV, link=link, command_gate=SHUT)
    yield robot
    robot.disconnect()


def driver(base: RosBridgedRobot, approved: bool = True) -> NavigatingBaseDeviceDriver:
    return NavigatingBaseDeviceDriver(
        base,
        authorization=Authorization(hardware=True, read_list=lambda _: ("operator",), robot="bench-1"),
        approval=Approval(lambda _: ("navigateTo",) if approved else (), lambda: False),
    )


async def test_a_goal_starts_and_returns_and_its_end_is_told(base: RosBridgedRobot, goals: list[Goal]) -> None:
    async with DriverBench(driver(base)) as bench:
        assert (await bench.call("navigateTo", x=1.0, y=2.0))["status"] == "success"
        assert (await bench.call("getStatus"))["task_status"] == "running"
        await until(lambda: goals)
        goals[0].end(4, {})
        await bench.until(lambda: bench.of("taskComplete"))
        assert (await bench.call("getStatus"))["task_status"] == "completed"


async def test_stop_cancels_the_goal_for_every_caller(base: RosBridgedRobot, goals: list[Goal]) -> None:
    async with DriverBench(driver(base)) as bench:
        await bench.call("navigateTo", x=1.0, y=2.0)
        await until(lambda: goals)
        assert (await bench.call("stop", "stranger"))["halted"] == ["navigation"]
        assert (await bench.call("getStatus"))["task_status"] == "stopped"


@pytest.mark.parametrize(
    "bad", [{"x": "1"}, {"y": float("nan")}, {"yaw": True}, {"frame_id": ""}, {"timeout": 0}, {"timeout": 3601}]
)
async def test_an_argument_outside_its_domain_begins_nothing(
    base: RosBridgedRobot, goals: list[Goal], bad: dict[str, Any]
) -> None:
    async with DriverBench(driver(base)) as bench:
        answer = await bench.call("navigateTo", **{"x": 1.0, "y": 2.0, **bad})
        assert next(iter(bad)) in answer["reason"]
    assert goals == []


async def test_a_goal_needs_the_callers_name_and_the_operators_leave(base: RosBridgedRobot, goals: list[Goal]) -> None:
    async with DriverBench(driver(base)) as bench:
        assert (await bench.call("navigateTo", "stranger", x=1.0, y=2.0))["status"] == "error"
    async with DriverBench(driver(base, approved=False)) as bench:
        assert "operator approval" in (await bench.call("navigateTo", x=1.0, y=2.0))["reason"]
    assert goals == []


def test_a_base_gets_this_driver_where_it_has_a_stack_and_everything_is_described(base: RosBridgedRobot) -> None:
    made = driver_for(base, "robot")
    assert isinstance(made, NavigatingBaseDeviceDriver)
    schema = next(f for f in made.functions if f.name == "navigateTo").parameters
    assert schema["required"] == ["x", "y"]
    assert all(len(prop["description"]) > 10 for prop in schema["properties"].values())
    plain = driver_for(RosBridgedRobot("plain", "/cmd_vel", "/odom", link=MemoryLink()), "robot")
    assert type(plain) is MobileBaseDeviceDriver
