"""The follower of a teleoperation: who holds it, and who stopped it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.waiting import eventually

from strands_robots.cli import output, teleop
from strands_robots.cli.leading import begin_policy
from strands_robots.cli.led_robot import LedRobot, Serving, halted_first
from strands_robots.cli.output import CliError, Screen, wait_until
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


def test_policy_that_the_command_runs_holds_the_robot_by_name_and_ends_with_a_stop(
    arm: HardwareRobot, leases: ControlLeases
) -> None:
    led = LedRobot(arm, "arm-1")
    task = begin_policy(Screen(), led, "mock", "wave", 30.0)
    eventually(lambda: task.step_count > 0, within=5)
    with pytest.raises(NotHolderError, match=r"mock \(agent\) holds control"):
        leases.admit("moveJoints", "alice", "", "")
    assert stop_executor().submit(arm, "arm-1", "stopped by alice").result().stopped
    assert (led.stopped, led.stopped_by, task.voided) == (True, "stopped by alice.", True)
    latch = LockoutLatch("arm-1")
    latch.engage("0" * 32, "bob", "smoke")
    arm.gate.attach(latch)
    with pytest.raises(CliError, match="locked by the emergency stop of bob"):
        begin_policy(Screen(), LedRobot(arm), "mock", "wave", 30.0)


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


def test_stop_that_comes_while_it_begins_to_be_led_ends_that(arm: HardwareRobot) -> None:
    led = LedRobot(arm, "arm-1")
    with led.held_by("keyboard", lambda: bool(arm.teleoperating())):
        stop_executor().submit(arm, "arm", "stop by alice").result()
        assert arm.teleoperate()["status"] == "success"
    eventually(lambda: not arm.teleoperating(), within=2.0)
    assert led.stopped
    assert led.stopped_by.startswith("stop by alice")


def test_robot_that_another_moves_after_the_stop_is_halted_at_the_end(
    arm: HardwareRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    led = LedRobot(arm, "arm-1")
    lead(led)
    stop_executor().submit(arm, "arm", "stop by alice").result()

    def hold(screen: Screen) -> Any:
        arm.stop_teleoperate()
        assert arm.teleoperate()["status"] == "success"
        return led.verdict()

    monkeypatch.setattr(led, "hold", hold)
    verdict, by = teleop._ended(Screen(True), led, teleop._halted(led))
    assert (verdict.stopped, by) == (True, "stop by alice.")
    eventually(lambda: not arm.teleoperating())
    refused = arm.teleoperate()
    assert "the robot is being taken off its network" in refused["reason"]


def test_follower_is_halted_before_its_stream_is_closed(arm: HardwareRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    halt: Callable[[str], Any] = arm.halt
    counters = dict.fromkeys(("frames_received", "errors", "rejected", "slew_rejected", "rate_dropped"), 0)

    @contextmanager
    def followed(*_: object) -> Iterator[object]:
        try:
            yield SimpleNamespace(stats=counters, over=lambda: "It has ended.")
        finally:
            done.append("closed")

    @contextmanager
    def made(*_: object) -> Iterator[LedRobot]:
        yield LedRobot(arm)

    def halt_noted(reason: str) -> Any:
        done.append("halted")
        return halt(reason)

    monkeypatch.setattr("strands_robots.fleet.mesh.leading.followed", followed)
    monkeypatch.setattr(teleop, "made_follower", made)
    monkeypatch.setattr(arm, "halt", halt_noted)
    how, options = Serving(None), teleop.TeleopOptions()
    teleop._follow(Screen(True), "lead-1", "arm", {}, how=how, options=options, record=None)
    assert done == ["halted", "closed"]


def test_wait_ends_before_its_bar_is_taken_from_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    @contextmanager
    def bar(*_: object) -> Iterator[Callable[[float], None]]:
        yield lambda _: None
        done.append("bar")

    def interrupted() -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(output, "progress_bar", bar)
    assert wait_until(Screen(True), interrupted, 5.0, at_end=lambda: done.append("halted")) == "Ctrl-C."
    assert done == ["halted", "bar"]


@pytest.mark.parametrize("ended_by", [signal.SIGTERM, signal.SIGHUP])
def test_robot_is_halted_when_its_command_or_its_terminal_ends(arm: HardwareRobot, ended_by: signal.Signals) -> None:
    before = signal.getsignal(ended_by)
    arm.teleoperate()
    with pytest.raises(KeyboardInterrupt), halted_first(arm):
        signal.raise_signal(ended_by)
    eventually(lambda: not arm.teleoperating())
    assert signal.getsignal(ended_by) is before
