"""The follower of a teleoperation: who holds it, and who stopped it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader

from strands_robots.cli.led_robot import LedRobot
from strands_robots.cli.output import CliError
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.lockout import LockoutLatch
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.serving.control import NotHolderError
from strands_robots.serving.control_leases import ControlLeases, leases_of


@pytest.fixture
def arm() -> Iterator[HardwareRobot]:
    robot = HardwareRobot(RecordingDevice(), "arm", control_hz=200)
    robot.connect()
    robot.attach_teleop(ScriptedLeader({"pan.pos": (20.0, 5.0, 1.0)}))
    yield robot
    robot.cleanup()


@pytest.fixture
def leases(arm: HardwareRobot) -> ControlLeases:
    return leases_of(arm, hardware=True)


def lead(led: LedRobot) -> None:
    with led.held_by("keyboard", lambda: bool(led.robot.teleoperating())):
        led.robot.teleoperate()


def test_leader_holds_the_robot_by_name_until_it_leads_no_more(arm: HardwareRobot, leases: ControlLeases) -> None:
    lead(LedRobot(arm, "arm-1"))
    assert leases.facts()["holder"] == "keyboard"
    with pytest.raises(NotHolderError, match=r"keyboard \(human\) holds control"):
        leases.admit("moveJoints", "alice", "", "")
    with pytest.raises(NotHolderError, match=r"keyboard \(human\) holds control"):
        leases.of().acquire("alice", "human", 10.0)
    arm.stop_teleoperate()
    assert leases.facts()["held"] is False


def test_robot_that_another_holds_is_not_led(arm: HardwareRobot, leases: ControlLeases) -> None:
    leases.of().acquire("alice", "human", 10.0)
    with pytest.raises(CliError, match=r"alice \(human\) holds control"):
        lead(LedRobot(arm, "arm-1"))
    assert not arm.teleoperating()


def test_start_that_is_refused_leaves_the_robot_free(arm: HardwareRobot, leases: ControlLeases) -> None:
    with LedRobot(arm, "arm-1").held_by("keyboard", lambda: False):
        pass
    assert leases.facts()["held"] is False


def test_robot_on_no_network_is_held_by_nobody(arm: HardwareRobot, leases: ControlLeases) -> None:
    led = LedRobot(arm)
    lead(led)
    assert leases.facts()["held"] is False
    assert not led.stopped


def test_it_says_who_stopped_it_and_who_locked_it(arm: HardwareRobot) -> None:
    led = LedRobot(arm, "arm-1")
    lead(led)
    assert not led.stopped
    stop_executor().submit(arm, "arm", "stop by alice")
    assert led.stopped
    assert led.stopped_by == "stop by alice."
    verdict = led.verdict()
    assert verdict is not None
    assert verdict.stopped is True
    latch = LockoutLatch("arm-1")
    latch.engage("0" * 32, "bob", "smoke")
    arm.gate.attach(latch)
    assert led.stopped_by.startswith("arm-1 is locked by the emergency stop of bob ('smoke')")
