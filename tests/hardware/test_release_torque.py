"""``releaseTorque``: stops a robot and switches its torque off, also while it is locked."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.devices import RecordingDevice, TorqueDevice
from fixtures.waiting import eventually

from strands_robots.audit import flush_audit, read_audit_log
from strands_robots.envelope import RefusalReason, Refused
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.authorization import Approval
from strands_robots.safety.lockout import LockoutLatch
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.robot_verbs import TASK_VERBS
from strands_robots.serving.verbs import Arguments

ALL = ["pan", "lift", "grip"]


@pytest.fixture
def robot() -> Iterator[HardwareRobot]:
    made = HardwareRobot(TorqueDevice(), "arm", control_hz=200)
    made.connect()
    yield made
    made.cleanup()


def locked(robot: HardwareRobot) -> HardwareRobot:
    latch = LockoutLatch("arm-1")
    latch.engage("a" * 32, "tester", "a trapped finger")
    robot.gate.attach(latch)
    return robot


def served(robot: Any, *approved: str, allowed: bool = True, verbs: Any = TASK_VERBS, **arguments: Any) -> Result:
    def authorize(command: Command, checked: Arguments) -> None:
        if not allowed:
            raise Refused(RefusalReason.CALLER, "not you")

    approval = Approval(lambda _: approved, lambda: False)
    line = Pipeline.of(robot, lambda: "arm-1", hardware=True, authorize=authorize, approval=approval)
    results: list[Result] = []
    asked = line.pending.arrive()
    line.serve(Command(verbs["releaseTorque"], arguments, "agent", asked), results.append)
    return results[0]


@pytest.mark.parametrize("verbs", [TASK_VERBS, PEER_VERBS], ids=["Device Connect", "mesh"])
def test_a_locked_robot_lets_go_with_the_operators_approval_alone(robot: HardwareRobot, verbs: Any) -> None:
    refused = served(locked(robot), verbs=verbs)
    assert refused.refusal is not None
    assert refused.refusal.why is RefusalReason.APPROVAL
    assert "grant releaseTorque@arm-1" in refused.result["reason"]
    assert robot.device.limp == []
    assert served(robot, "releaseTorque", verbs=verbs).result["released"] == ALL
    assert robot.device.limp == ALL


def test_a_caller_who_may_not_move_it_may_not_let_it_fall(robot: HardwareRobot) -> None:
    refused = served(locked(robot), "releaseTorque", allowed=False)
    assert refused.refusal is not None
    assert refused.refusal.why is RefusalReason.CALLER
    assert robot.device.limp == []


def test_a_halt_that_came_after_the_call_does_not_refuse_it(robot: HardwareRobot) -> None:
    line = Pipeline.of(robot, lambda: "arm-1", hardware=False, authorize=lambda command, arguments: None)
    asked = line.pending.arrive()
    robot.halt("test")
    results: list[Result] = []
    line.serve(Command(TASK_VERBS["releaseTorque"], {}, "agent", asked), results.append)
    assert results[0].result["status"] == "success"


def test_what_moves_is_stopped_first(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    eventually(lambda: len(robot.device.writes) > 3)
    answer = robot.release_torque()
    written = len(robot.device.writes)
    assert (answer["status"], answer["stopped"], answer["halted"]) == ("success", True, ["task"])
    assert robot.get_task_status()["task_status"] == "stopped"
    assert robot.device.limp == ALL
    assert len(robot.device.writes) == written


def test_one_motor_lets_go_and_the_others_freeze(robot: HardwareRobot) -> None:
    robot.send_action({"pan.pos": 20.0, "grip.pos": 90.0})
    answer = robot.release_torque("grip")
    assert answer["released"] == ["grip"]
    assert robot.device.limp == ["grip"]
    assert robot.device.writes[-1].action == {"pan.pos": 20.0, "lift.pos": 10.0}, "a motor without torque has no target"
    assert robot.halt("test").stopped is True
    assert robot.device.limp == ["grip"], "a stop does not close the gripper again"


def test_a_motion_after_it_begins_where_the_robot_is(robot: HardwareRobot) -> None:
    robot.release_torque()
    robot.device.positions["lift.pos"] = -70.0
    assert robot.send_action({"pan.pos": 11.0})["status"] == "success"
    assert robot.device.limp == []
    assert robot.device.positions == {"pan.pos": 11.0, "lift.pos": -70.0, "grip.pos": 10.0}


@pytest.mark.parametrize("motors", ["tail", "grip,tail", "1"])
def test_a_motor_that_it_does_not_have_is_refused_by_name(robot: HardwareRobot, motors: str) -> None:
    assert "motor_ids must be one of pan, lift, grip" in robot.release_torque(motors)["reason"]
    assert robot.device.limp == []


def test_a_motor_that_does_not_confirm_is_named(robot: HardwareRobot) -> None:
    off = robot.device.bus.disable_torque

    def silent(motor: str) -> None:
        if motor == "lift":
            raise ConnectionError("no status packet")
        off(motor)

    robot.device.bus.disable_torque = silent
    answer = robot.release_torque()
    assert (answer["status"], answer["released"]) == ("error", ["pan", "grip"])
    assert "lift" in answer["reason"]
    robot.device.bus.disable_torque = off


def test_a_bus_that_hangs_is_answered_within_the_deadline(
    robot: HardwareRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    let_go = threading.Event()
    taken = threading.Event()

    def hold() -> None:
        with robot.body().lock:
            taken.set()
            let_go.wait(20)

    held = threading.Thread(target=hold)
    held.start()
    assert taken.wait(20)
    answer = robot.release_torque()
    assert answer["status"] == "error"
    assert answer["released"] == []
    let_go.set()
    held.join(20)
    eventually(lambda: robot.device.limp == ALL, what="it lets go as soon as the bus answers")


def test_a_robot_whose_torque_cannot_be_switched_says_so() -> None:
    robot = HardwareRobot(RecordingDevice(), "stiff")
    robot.connect()
    assert "cannot switch" in robot.release_torque()["reason"]
    robot.cleanup()


def test_it_is_in_the_audit(robot: HardwareRobot) -> None:
    robot.release_torque("grip")
    assert flush_audit(60.0)
    assert [record for record in read_audit_log() if "torque_released" in record.values()]
