"""A real arm's joint that meets a fixed thing ends its motion, by its lag and its current on emulated servos.

The servos note when their shaft touches, what they are told after that and which registers are read, so that nothing
depends on how fast this machine is: a setpoint is one control step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import pytest
from fixtures.feetech_bus import REGISTERS, FeetechBus
from fixtures.waiting import eventually

from strands_robots.hardware.emulated import COUNTS, STALL_A, STALL_NM

PAN, LIFT = 1, 2
CONTACT_S = 0.3
SLOW = 0.05
"""Share of full speed: 0.1 rad/s."""

LAG_DEGREES = 2.8
"""Distance at which the lag alone of 3 degrees shows contact; some of it there was before the touch."""

Arm = Callable[..., Any]


class Pan:
    """What the servo of the pan joint goes through on its way into a fixed thing.

    Attributes:
        touched: monotonic time at which the shaft was first at the thing, None before.
        current_reads: monotonic times at which its current was asked for.
    """

    def __init__(self, bus: FeetechBus, ahead: float = 200.0) -> None:
        self.bus, self.servo = bus, bus.servos[PAN]
        self.touched: float | None = None
        self.current_reads: list[float] = []
        self._block = self.servo.blocked_at = self.servo.shaft + ahead
        self._advance, self._answers = self.servo.advance, self.servo.answers
        self.servo.advance = self.advance  # type: ignore[method-assign]
        self.servo.answers = self.answers  # type: ignore[method-assign]

    def advance(self, seconds: float) -> None:
        self._advance(seconds)
        if self.touched is None and abs(self.servo.shaft - self._block) <= 1.5:
            self.touched = time.monotonic()

    def answers(self, address: int) -> bool:
        if address == REGISTERS["present_current"][0]:
            self.current_reads.append(time.monotonic())
        return self._answers(address)

    def forget(self) -> None:
        """Forget the touch and the reads, for another motion into the same thing."""
        self.touched, self.current_reads = None, []

    def goals_after_touch(self) -> list[tuple[float, int]]:
        """Times and positions that it was told in the motion once it had touched, without the hold at the end."""
        assert self.touched is not None
        written = [each for each in self.bus.written_after(self.touched) if each.servo == PAN]
        goals = [(each.at, int.from_bytes(each.data, "little")) for each in written]
        furthest = max(goal for _, goal in goals)
        last = max(index for index, (_, goal) in enumerate(goals) if goal == furthest)
        return goals[: last + 1]

    def after_touch_s(self) -> float:
        """How long the motion went on after the touch, by the clock of the servos."""
        assert self.touched is not None
        return self.goals_after_touch()[-1][0] - self.touched

    def overrun_degrees(self) -> float:
        """How far the setpoints went on beyond the fixed thing."""
        furthest = self.goals_after_touch()[-1][1] + self.servo.get("homing_offset")
        return (furthest - self._block) * 360 / COUNTS


def pushed(robot: Any, pan: Pan, speed: float) -> None:
    """Move the pan joint into the fixed thing; its name ends the motion."""
    answer = robot.move_joints({"shoulder_pan": 60.0}, speed=speed)
    assert answer["status"] == "error"
    assert answer["why"].startswith("shoulder_pan was blocked at 17 degrees"), answer
    print(f"speed {speed}: {pan.after_touch_s():.3f} s after touch, {pan.overrun_degrees():.2f} degrees beyond it")


@pytest.mark.parametrize("speed", [0.25, 0.5, 1.0])
def test_joint_that_meets_a_fixed_thing_ends_the_motion_by_its_name(arm: Arm, bus: FeetechBus, speed: float) -> None:
    robot, pan = arm(use_degrees=True), Pan(bus)
    pushed(robot, pan, speed)
    assert len(pan.goals_after_touch()) / robot.control_hz <= CONTACT_S
    pan.servo.blocked_at = None
    free = robot.move_joints({"shoulder_pan": 40.0}, speed=speed)
    assert free["why"] == "it is done"


def test_slow_joint_presses_less_where_its_current_is_read(arm: Arm, bus: FeetechBus) -> None:
    robot, pan = arm(use_degrees=True), Pan(bus)
    pushed(robot, pan, SLOW)
    assert pan.current_reads
    assert pan.touched is not None
    assert min(pan.current_reads) >= pan.touched
    with_current = pan.overrun_degrees()
    assert robot.move_joints({"shoulder_pan": 0.0})["why"] == "it is done"
    pan.forget()
    pan.servo.silent = frozenset({"present_current"})
    pushed(robot, pan, SLOW)
    assert pan.overrun_degrees() >= LAG_DEGREES
    assert with_current <= LAG_DEGREES - 0.5


def test_lost_current_is_asked_for_once_and_changes_nothing(arm: Arm, bus: FeetechBus) -> None:
    robot, pan = arm(use_degrees=True), Pan(bus)
    pan.servo.silent = frozenset({"present_current"})
    pushed(robot, pan, SLOW)
    assert len(pan.current_reads) == 1
    assert pan.overrun_degrees() >= LAG_DEGREES
    assert all(servo.torque for servo in bus.servos.values())
    assert robot.halt("test").stopped is True


@pytest.mark.parametrize(("share", "speed"), [(0.0, 0.5), (0.4, SLOW), (0.55, SLOW), (0.55, 1.0)])
def test_payload_ends_no_motion(arm: Arm, bus: FeetechBus, share: float, speed: float) -> None:
    robot, pan = arm(use_degrees=True), Pan(bus, ahead=1000.0)
    lift = bus.servos[LIFT]
    advance, middle = lift.advance, lift.shaft

    def carry(seconds: float) -> None:
        # A stretched arm carries most. Of 0.55 it sags by 3.3 degrees; from 3.4 on a motion begins where the arm is.
        lift.payload_nm = share * STALL_NM * math.cos((lift.shaft - middle) * math.tau / COUNTS)
        advance(seconds)

    lift.advance = carry  # type: ignore[method-assign]
    for goal in (-12.0, 12.0):
        answer = robot.move_joints({"shoulder_lift": goal, "shoulder_pan": goal}, speed=speed)
        assert "blocked" not in answer["why"], answer
    assert lift.current == pytest.approx(share * STALL_A, abs=0.2)
    if not share:
        assert pan.current_reads == [], "no joint stood still"


def test_stop_while_a_current_is_not_answered_stops(arm: Arm, bus: FeetechBus) -> None:
    robot, pan = arm(use_degrees=True), Pan(bus)
    pan.servo.silent = frozenset({"present_current"})
    answer = robot.move_joints({"shoulder_pan": 60.0}, speed=SLOW, wait=False)
    assert answer["status"] == "success"
    eventually(lambda: pan.current_reads, what="the read that gets no answer")
    asked = len(pan.current_reads)
    assert robot.halt("test").stopped is True
    halted = time.monotonic()
    assert len(pan.current_reads) == asked, "no current is read again before the halt"
    assert bus.written_after(halted) == []
    # What it was told in the halt is where it stands.
    (held,) = {int.from_bytes(each.data, "little") for each in bus.writes[-6:] if each.servo == PAN}
    assert held + pan.servo.get("homing_offset") == pytest.approx(pan.servo.shaft, abs=2)
