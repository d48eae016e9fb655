"""Halts of robots whose own verbs run, by the stop executor: of foreign robots and of ours."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from fixtures.barista import Barista, Stubborn
from fixtures.devices import RecordingDevice, TorqueDevice
from fixtures.waiting import eventually

from strands_robots import Permit, verb
from strands_robots.adapted import adapt
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.gate import MotionGate, MotionRefused
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_targets import void_calls
from strands_robots.safety.stopping import PendingVerdict, StopVerdict


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


class Holds:
    """A robot that fits the contract by itself; where its gate is kept is its author's choice."""

    tool_name_str = "holds"

    def __init__(self) -> None:
        self.started, self.released = threading.Event(), threading.Event()

    def start_task(self, instruction: str, **options: Any) -> dict[str, Any]:
        return {"status": "success"}

    def stop_task(self) -> dict[str, Any]:
        return {"status": "success"}

    get_task_status = get_features = get_state = stop_task

    def subscribe(self, observer: object) -> Any:
        return lambda: None

    def halt(self, reason: str = "") -> StopVerdict:
        self.gate.revoke()
        return StopVerdict()

    @verb(motion=True, lasts=60.0)
    def hang(self, permit: Permit) -> None:
        """Hang."""
        self.started.set()
        self.released.wait(60.0)


class OfTheClass(Holds):
    gate = MotionGate()


class ByProperty(Holds):
    _own = MotionGate()

    @property
    def gate(self) -> MotionGate:
        return self._own


class Misleading(ByProperty):
    verbs_under_way: Any = ()
    under_way: Any = None


@pytest.mark.parametrize("kind", [OfTheClass, ByProperty, Misleading])
def test_verb_is_waited_for_wherever_the_robot_keeps_its_gate(kind: type[Holds]) -> None:
    robot = kind()
    working = threading.Thread(target=robot.hang)
    working.start()
    eventually(robot.started.is_set)
    try:
        verdict = stop_executor().halt(robot, "holds", "stop", within=0.4)
        assert verdict.stopped is False
        assert "has not returned" in verdict.not_stopped["hang"]
    finally:
        robot.released.set()
        working.join(20.0)


class Hanging(HardwareRobot):
    """A real arm with a verb that ignores its permit."""

    def __init__(self, *values: Any, **options: Any) -> None:
        super().__init__(*values, **options)
        self.started, self.released = threading.Event(), threading.Event()
        self.halts = 0

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        self.halts += 1
        return super().halt_here(reason, deadline)

    @verb(motion=True, lasts=60.0)
    def hang(self, permit: Permit) -> None:
        """Hang."""
        self.started.set()
        self.released.wait(60.0)


class HaltsTwice(Hanging):
    """An arm whose halt does something besides."""

    def halt(self, reason: str = "") -> StopVerdict:
        return super().halt(reason)


@pytest.mark.parametrize("kind", [Hanging, HaltsTwice])
def test_second_stop_of_an_arm_begins_beside_the_first_ones_verb(kind: type[Hanging]) -> None:
    arm = kind(RecordingDevice(), "arm")
    arm.connect()
    working = threading.Thread(target=arm.hang)
    working.start()
    eventually(arm.started.is_set)
    try:
        first = arm.halts
        stops = []
        for number in range(1, 4):
            stops.append(stop_executor().submit(arm, "arm", f"{number}", within=1.5))
            # The halt of each begins while the one before still waits for its verb.
            eventually(lambda wanted=first + number: arm.halts >= wanted)
        assert not any(each.done() for each in stops)
        assert [each.result(20.0).stopped for each in stops] == [False] * 3
        assert arm.stop_task()["status"] == "error"
    finally:
        arm.released.set()
        working.join(20.0)
    assert arm.stop_task()["status"] == "success"


def test_arm_settles_once_its_verb_has_returned_and_not_before(patient_halts: None) -> None:
    device = TorqueDevice()
    rest = dict.fromkeys(device.action_features, 0.0)
    arm = Hanging(device, "arm", stop_level="settle", rest_pose=rest)
    arm.connect()
    arm.send_action(dict.fromkeys(device.action_features, 1.0))
    working = threading.Thread(target=arm.hang)
    working.start()
    eventually(arm.started.is_set)
    stop = stop_executor().submit(arm, "arm", "stop", within=0.5)
    refused = stop.result(20.0)
    assert (refused.stopped, refused.settling) == (False, False)
    arm.released.set()
    working.join(20.0)
    assert stop_executor().halt(arm, "arm", "again").stopped is True


def test_one_verb_runs_at_a_time_and_none_is_lost() -> None:
    robot = Barista()
    done: list[int] = []
    refused: list[str] = []

    def brew() -> None:
        for _ in range(200):
            try:
                done.append(robot.brew_coffee(1)["cups"])
            except MotionRefused as exc:
                refused.append(str(exc))

    callers = [threading.Thread(target=brew) for _ in range(4)]
    for each in callers:
        each.start()
    for each in callers:
        each.join(60.0)
    assert len(done) + len(refused) == 800
    assert robot.cups == len(done)


def test_verb_of_an_arm_that_halts_it_does_not_wait_for_itself() -> None:
    class Careful(HardwareRobot):
        @verb
        def feel(self, permit: Permit) -> dict[str, Any]:
            """Feel."""
            began = time.monotonic()
            return {"stopped": self.halt("I felt something").stopped, "took_s": time.monotonic() - began}

    arm = Careful(RecordingDevice(), "arm")
    arm.connect()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STRANDS_HALT_DEADLINE_S", "30")
        felt = arm.feel()
    assert felt["stopped"] is True
    assert felt["took_s"] < 20.0


def test_robot_whose_tasks_no_stop_would_end_did_not_stop_though_it_has_verbs() -> None:
    class Endless(Barista):
        def start_task(self, instruction: str, **options: Any) -> dict[str, Any]:
            return {"status": "success"}

    assert adapt(Endless()).halt().stopped is False


def test_teleoperation_of_a_robot_without_tasks_is_stopped_as_well(patient_halts: None) -> None:
    class Led(Barista):
        def stop_teleoperate(self) -> dict[str, Any]:
            return {"status": "error", "reason": "the leader hangs"}

    verdict = stop_executor().halt(adapt(Led()), "led", "stop")
    assert verdict.stopped is False
    assert "the leader hangs" in verdict.not_stopped["teleoperation"]


def test_no_attribute_of_a_robot_is_asked_before_its_halt() -> None:
    asked: list[str] = []

    class Watched(Holds):
        gate = MotionGate()

        def __getattribute__(self, name: str) -> Any:
            asked.append(name)
            return super().__getattribute__(name)

    robot = Watched()
    asked.clear()
    assert void_calls(robot) == ()
    assert asked == []
