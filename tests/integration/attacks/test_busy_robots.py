"""Stops of robots that load, move on a busy machine, or raise the stop themselves: none says what is not so."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from fixtures.bodies import LoadingPolicy
from fixtures.devices import TorqueDevice
from fixtures.nats_server import NatsServer
from fixtures.planes import own_plane
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually

from strands_robots import policies
from strands_robots.device_connect import LinkConfig, init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.envelope import Envelope
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.plane import plane
from strands_robots.simulation import Simulation

STOPS = 10
ARMS = ("arm-1", "arm-2")

pytestmark = pytest.mark.usefixtures("patient_halts")


@pytest.fixture
def busy_machine() -> Iterator[None]:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def begun(start: Callable[[], Envelope]) -> None:
    """Start a motion; a loop that had not returned when its robot was locked occupies the robot until it has."""
    eventually(lambda: start()["status"] == "success", 60.0, what="the start of a motion")


@pytest.mark.usefixtures("busy_machine")
def test_an_arm_that_moved_is_named_at_each_stop_on_a_busy_machine() -> None:
    robot = HardwareRobot(TorqueDevice(), "arm", control_hz=100)
    robot.connect()
    world = Simulation()
    world.add_robot("twin", "so100")
    with own_plane(20.0) as safety:
        safety.register("arm", robot)
        safety.register("world", world)
        for _ in range(STOPS):
            written = len(robot.device.writes)
            begun(lambda: robot.start_task("wave", duration=300.0))
            begun(lambda: world.start_policy("twin", "wave", duration=300.0))
            eventually(lambda written=written: len(robot.device.writes) > written)
            reports = safety.emergency_stop(StopOrder(new_epoch(), "safety-1"))
            assert {name: (each.stopped, each.verdict.halted) for name, each in reports.items()} == {
                "arm": (True, ("task",)),
                "world": (True, ("twin",)),
            }
            safety.clear_local("the test")
    world.cleanup()
    robot.cleanup()


def test_an_arm_whose_policy_loads_is_stopped_at_each_stop_and_never_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = HardwareRobot(TorqueDevice(), "arm")
    robot.connect()
    with own_plane(20.0) as safety:
        safety.register("arm", robot)
        for _ in range(STOPS):
            loading = LoadingPolicy()
            monkeypatch.setattr(policies, "policy_factory", lambda name, loading=loading: lambda: loading)
            robot.start_task("wave")
            assert loading.loads.wait(20)
            report = safety.emergency_stop(StopOrder(new_epoch(), "safety-1"))["arm"]
            assert report.stopped is True
            loading.loaded.set()
            eventually(lambda: robot.get_task_status()["task_status"] == "stopped")
            safety.clear_local("the test")
    assert all(write.action.get("pan.pos") != 99.0 for write in robot.device.writes)
    robot.cleanup()


def test_a_device_that_raises_the_stop_itself_is_locked_and_still_each_time_and_so_is_the_other() -> None:
    with NatsServer() as server:
        link = LinkConfig(transport="nats", connect=(server.url,))
        robots = {name: ToyRobot(name) for name in ARMS}
        drivers = [RobotDeviceDriver(robot) for robot in robots.values()]
        runtimes = [
            init_device_connect_sync(driver, peer_id=name, link=link, allow_insecure=True)
            for name, driver in zip(ARMS, drivers, strict=True)
        ]
        try:
            eventually(lambda: all(each.link.up for each in estop_listener().registrations))
            for number in range(STOPS):
                for robot in robots.values():
                    assert robot.start_task("wave", duration=300.0)["status"] == "success"
                asyncio.run(drivers[number % 2].emergencyStop(reason="smoke"))
                lockouts = plane().lockouts()
                assert {each.source for name in ARMS for each in lockouts[name]} == {ARMS[number % 2]}
                assert all(robot.start_task("wave")["status"] == "error" for robot in robots.values())
                eventually(lambda: all(not each.running for r in robots.values() for each in r.rollouts.values()))
                plane().clear_local("the test")
        finally:
            for runtime in runtimes:
                stop_device_connect(runtime)
            for robot in robots.values():
                robot.close()
