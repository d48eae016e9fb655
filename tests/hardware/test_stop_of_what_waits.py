"""Stops of a robot whose motion has not begun yet, and of one that is not there any more."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.waiting import eventually

from strands_robots.envelope import error
from strands_robots.hardware import HardwareRobot
from strands_robots.hardware import robot as hardware_robot
from strands_robots.safety.gate import Permit

WAVES = {"pan.pos": (0.0, 50.0, 1.0)}


class Locked:
    def refusal(self, verb: str) -> dict[str, Any]:
        return error(f"{verb} is locked.")


@pytest.fixture
def robot() -> Iterator[HardwareRobot]:
    made = HardwareRobot(RecordingDevice(), "waiting", control_hz=200)
    made.connect()
    yield made
    made.device.is_connected = True
    made.cleanup()


@pytest.fixture
def loading(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Set to let the policy that is being made be ready."""
    ready, asked = threading.Event(), threading.Event()

    def slow(name: str, **options: Any) -> ScriptedPolicy:
        asked.set()
        assert ready.wait(60)
        return ScriptedPolicy([], always={"pan.pos": 90.0})

    ready.asked = asked  # type: ignore[attr-defined]
    monkeypatch.setattr(hardware_robot, "create_policy", slow)
    yield ready
    ready.set()


def on_a_thread(call: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    answers: list[Any] = []
    thread = threading.Thread(target=lambda: answers.append(call()))
    thread.start()
    return thread, answers


def line_of(robot: HardwareRobot) -> threading.Semaphore:
    """Released each time that a motion is given leave: from then on it stands in line, and a halt reaches it."""
    given, permit = threading.Semaphore(0), robot.gate.permit

    def giving(verb: str) -> Permit:
        leave = permit(verb)
        given.release()
        return leave

    robot.gate.permit = giving  # type: ignore[method-assign]
    return given


STOPS = {"stop_task": lambda robot: robot.stop_task(), "halt": lambda robot: robot.halt("test").envelope()}


@pytest.mark.parametrize("verb", STOPS)
def test_a_stop_reaches_a_task_whose_policy_still_loads(robot: HardwareRobot, loading: Any, verb: str) -> None:
    thread, answers = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    assert STOPS[verb](robot)["stopped"] is True
    written = len(robot.device.writes)
    loading.set()
    thread.join(20)
    assert "halted after it was asked for" in answers[0]["reason"]
    assert not robot.occupied("waiting")
    assert len(robot.device.writes) == written


@pytest.mark.parametrize(
    "motion",
    [
        lambda robot: robot.start_task("nod"),
        lambda robot: robot.send_action({"pan.pos": 90.0}),
        lambda robot: robot.teleoperate("leader"),
    ],
    ids=["start_task", "send_action", "teleoperate"],
)
def test_a_halt_reaches_what_stands_in_line_behind_a_loading_policy(
    robot: HardwareRobot, loading: Any, motion: Callable[[HardwareRobot], Any]
) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    given = line_of(robot)
    first, _ = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    assert given.acquire(timeout=20)
    second, answers = on_a_thread(lambda: motion(robot))
    assert given.acquire(timeout=20), "it stands in line"
    second.join(0.1)
    assert second.is_alive()
    assert robot.halt("test").stopped is True
    written = len(robot.device.writes)
    loading.set()
    first.join(20)
    second.join(20)
    assert answers[0]["status"] == "error"
    assert not robot.occupied("waiting")
    assert not robot.teleoperating()
    assert len(robot.device.writes) == written


def test_a_leader_that_stands_in_line_is_stopped_by_its_own_stop(robot: HardwareRobot, loading: Any) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    first, _ = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    second, answers = on_a_thread(lambda: robot.teleoperate("leader"))
    eventually(lambda: "leader" in list(robot._teleop_waiting._permits.values()), what="it stands in line")
    assert robot.stop_teleoperate()["stopped"] is True
    robot.stop_task()
    loading.set()
    first.join(20)
    second.join(20)
    assert "halted after it was asked for" in answers[0]["reason"]
    assert not robot.teleoperating()


def test_a_robot_that_fell_off_its_network_in_mid_motion_is_not_called_stopped(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    eventually(lambda: len(robot.device.writes) > 3)
    robot.device.is_connected = False
    verdict = robot.halt("test")
    assert verdict.stopped is False
    assert "not connected" in str(verdict.not_stopped)
    assert robot.halt("again").stopped is not True, "nobody has frozen it since"
    robot.device.is_connected = True
    assert robot.halt("it is back").stopped is True


def test_a_robot_that_was_frozen_before_it_was_disconnected_stands_still(robot: HardwareRobot) -> None:
    robot.send_action({"pan.pos": 5.0})
    assert robot.cleanup()["status"] == "success"
    assert robot.halt("test").stopped is True


def test_a_locked_robot_whose_cable_is_back_is_frozen_as_it_connects(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    eventually(lambda: len(robot.device.writes) > 3)
    robot.device.is_connected = False
    robot.gate.attach(Locked())
    assert robot.halt("test").stopped is False
    written = len(robot.device.writes)
    robot.connect()
    assert len(robot.device.writes) == written + 1, "one write: hold where you are"
    assert robot.halt("again").stopped is True
