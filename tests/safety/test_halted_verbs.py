"""Halts of robots whose own verbs run, by the stop executor: of foreign robots and of ours."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from fixtures.barista import Barista, Stubborn
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots import Permit, verb
from strands_robots.contract import adapt
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.stop_executor import stop_executor


class Waving(HardwareRobot):
    """A real arm with a verb of its own, which writes through the robot's own body."""

    @verb(motion=True, lasts=60.0)
    def wave_hello(self, permit: Permit) -> dict[str, Any]:
        """Wave."""
        sent = 0
        while permit.valid:
            if self.send_action(dict.fromkeys(self.device.action_features, 1.0))["status"] == "success":
                sent += 1
        return {"sent": sent}


class HaltsItself(Barista):
    """A robot with a halt of its own, which says more than the truth."""

    def halt(self, reason: str = "") -> dict[str, Any]:
        return {"status": "success", "stopped": True}


class Raises(Barista):
    """A robot whose halt raises."""

    def halt(self, reason: str = "") -> None:
        raise OSError("the bus is gone")


def test_own_verb_of_a_real_arm_ends_with_its_halt_and_nothing_is_written_after(patient_halts: None) -> None:
    device = RecordingDevice()
    arm = Waving(device, "arm")
    arm.connect()
    working = threading.Thread(target=arm.wave_hello)
    working.start()
    eventually(lambda: device.writes)
    verdict = arm.halt("enough")
    assert verdict.stopped is True
    assert "waveHello" in verdict.halted
    written = len(device.writes)
    working.join(20.0)
    assert len(device.writes) == written


@pytest.mark.parametrize("kind", [Barista, HaltsItself])
def test_stop_by_the_executor_waits_for_the_verb(kind: type[Barista], patient_halts: None) -> None:
    robot = kind()
    target = adapt(robot)
    for _ in range(2):
        working = threading.Thread(target=robot.brew_coffee, args=(8,))
        working.start()
        eventually(robot.brewing.is_set)
        verdict = stop_executor().halt(target, "barista", "stop")
        assert verdict.stopped is True
        assert "brewCoffee" in verdict.halted
        assert not robot.brewing.is_set()
        working.join(20.0)


def test_robot_that_says_stopped_while_its_verb_runs_has_not_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    class Liar(Stubborn):
        def halt(self, reason: str = "") -> dict[str, Any]:
            return {"status": "success", "stopped": True}

    robot = Liar()
    working = threading.Thread(target=robot.grind)
    working.start()
    eventually(robot.started.is_set)
    try:
        began = time.monotonic()
        verdict = stop_executor().halt(adapt(robot), "liar", "stop", within=0.4)
        assert verdict.stopped is False
        assert "has not returned" in verdict.not_stopped["grind"]
        assert time.monotonic() - began < 20.0
    finally:
        robot.released.set()
        working.join(20.0)


def test_halt_that_raises_is_told_beside_the_verb(patient_halts: None) -> None:
    robot = Raises()
    working = threading.Thread(target=robot.brew_coffee, args=(8,))
    working.start()
    eventually(robot.brewing.is_set)
    verdict = stop_executor().halt(adapt(robot), "raises", "stop")
    working.join(20.0)
    assert verdict.stopped is False
    assert "the bus is gone" in str(verdict.not_stopped)
    assert "brewCoffee" in verdict.halted


def test_stop_behind_a_verb_that_hangs_begins_at_once() -> None:
    robot = Stubborn()
    target = adapt(robot)
    working = threading.Thread(target=robot.grind)
    working.start()
    eventually(robot.started.is_set)
    try:
        first = stop_executor().submit(target, "stubborn", "one", within=0.5)
        verdicts = [stop_executor().submit(target, "stubborn", f"{n}", within=0.5) for n in range(100)]
        assert [each.result(20.0).stopped for each in (first, *verdicts)] == [False] * 101
    finally:
        robot.released.set()
        working.join(20.0)
    assert stop_executor().halt(target, "stubborn", "last").stopped is True
